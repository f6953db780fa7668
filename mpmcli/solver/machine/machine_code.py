"""Puts machine code in the place of LLVM's text in a file of a compiled kernel, which no start has to make then.

It is a process of its own, `python -m mpmcli.solver.machine.machine_code FILE NAME`: where LLVM fails, it ends that.
The code is assembler in a module (`module asm`), which Taichi's LLVM assembles in a hundredth of the time.
"""

import contextlib
import hashlib
import os
import re
import struct
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

# A file of Taichi: magic, architecture, lengths of what follows; description, code; SHA-256 of both in hexadecimal.
HEAD = struct.Struct("<4sIQQ")
DIGEST = 64
# LLVM of Taichi, whose text later ones do not read, and versions of llvmlite that have it.
LLVM, LLVMLITE = 15, ("0.43", "0.44")
PRIORITY = 10


def can_be_made() -> bool:
    """Return whether this system takes such code, and llvmlite is there (the extra `quick`)."""
    try:
        return sys.platform == "linux" and version("llvmlite").startswith(LLVMLITE)
    except PackageNotFoundError:
        return False


def make_in_background(path: Path, name: str) -> int:
    """Start the process for a kernel whose functions begin with a name; return its number."""
    nothing = [(os.POSIX_SPAWN_OPEN, k, os.devnull, os.O_RDWR, 0) for k in range(3)]
    command = [sys.executable, "-P", "-m", "mpmcli.solver.machine.machine_code", str(path), name]
    # The same modules are found as in this process, wherever it was started from.
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(os.path.abspath, sys.path))}
    return os.posix_spawn(sys.executable, command, environment, file_actions=nothing, setsid=True)


def is_sound(content: bytes) -> bool:
    """Return whether a file of Taichi has the checksum that it states."""
    if len(content) < HEAD.size + DIGEST:
        return False
    _, _, described, code = HEAD.unpack_from(content)
    body, digest = content[HEAD.size : -DIGEST], content[-DIGEST:]
    return len(body) == described + code and hashlib.sha256(body).hexdigest().encode() == digest


def write(path: Path, content: bytes) -> None:
    """Replace a file, or make it, at once; OSError: it could not be written, and is as it was."""
    part = path.parent / f"mpmcli-{os.getpid()}.part"
    try:
        part.write_bytes(content)
        os.replace(part, path)
    except OSError:
        part.unlink(missing_ok=True)
        raise


def with_machine_code(content: bytes, name: str) -> bytes:
    """Return a file of Taichi with machine code for this processor in place of LLVM's text.

    Raises:
        RuntimeError: LLVM does not take it.
        ValueError: its functions are not those that are expected.
    """
    import llvmlite.binding as llvm

    if llvm.llvm_version_info[0] != LLVM:
        raise ValueError(f"llvmlite has LLVM {llvm.llvm_version_info[0]}, and not {LLVM}")
    magic, arch, described, length = HEAD.unpack_from(content)
    description, text = content[HEAD.size :][:described], content[HEAD.size + described :][:length].decode()
    functions = re.findall(rf"^define void @({name}\w*)\((?:[^(),]|\{{[^}}]*\}})*\)", text, re.MULTILINE)
    # A product and a sum may become one operation where the text says so, by options that Taichi sets otherwise.
    if not functions or "@llvm.fmuladd" in text or " contract " in text:
        raise ValueError("not a kernel whose code is known to be that of Taichi")
    llvm.initialize()
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    llvm.initialize_native_asmparser()
    target = llvm.Target.from_triple(llvm.get_process_triple()).create_target_machine(
        cpu=llvm.get_host_cpu_name(),
        features=llvm.get_host_cpu_features().flatten(),
        opt=3,
        reloc="pic",
        codemodel="default",
    )
    assembler = target.emit_assembly(llvm.parse_assembly(text))
    for function in functions:
        assembler = re.sub(rf"\b{function}\b", f"own_{function}", assembler)
    assembler = re.sub(r"^\s*\.globl\s+own_.*\n", "", assembler, flags=re.MULTILINE)
    # Labels, which are numbered from 0 on for the functions below too.
    assembler = re.sub(r"\.L(?=\w)", ".Lown_", assembler)
    made = [line for line in text.split("\n")[:20] if line.startswith(("source_filename", "target "))]
    for line in filter(str.strip, assembler.split("\n")):
        made.append('module asm "{}"'.format(line.replace("\\", "\\5C").replace('"', "\\22")))
    for function in functions:
        made += [f"declare void @own_{function}(i8*)", f"define void @{function}(i8* %context) {{"]
        made += [f"  call void @own_{function}(i8* %context)", "  ret void", "}"]
    code = "\n".join([*made, ""])
    # What cannot be assembled here ends this process, and no other.
    target.emit_object(llvm.parse_assembly(code))
    body = description + code.encode()
    digest = hashlib.sha256(body).hexdigest().encode()
    return HEAD.pack(magic, arch, described, len(code.encode())) + body + digest


def main(path: Path, name: str) -> None:
    with contextlib.suppress(OSError):
        os.nice(PRIORITY)
    content = path.read_bytes()
    if is_sound(content) and name.encode() in content and b"module asm" not in content:
        write(path, with_machine_code(content, name))


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2])
