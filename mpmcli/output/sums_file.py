"""checksums.sha256: the SHA-256 of the other files of a directory, as `sha256sum -c` reads it."""

import re
from collections.abc import Mapping, Sequence
from hashlib import file_digest, sha256
from pathlib import Path

from mpmcli.output.durable import write_text
from mpmcli.output.hdf5_items import DamageError

SUMS = "checksums.sha256"
# Names of our own files are plain.
_LINE = re.compile(r"([0-9a-f]{64})  (\w[\w.-]*)\n")


def text_digest(text: str) -> str:
    """Return the SHA-256 of a text in UTF-8, hexadecimal."""
    return sha256(text.encode("utf-8")).hexdigest()


def path_digest(path: Path) -> str:
    """Return the SHA-256 of a file, hexadecimal."""
    with path.open("rb") as file:
        return file_digest(file, "sha256").hexdigest()


def sums_text(sums: Mapping[str, Sequence[str]]) -> str:
    """Write digests by the names of files; a file that is about to be replaced has two."""
    return "".join(f"{digest}  {name}\n" for name in sorted(sums) for digest in sums[name])


def write_sums(directory: Path, sums: Mapping[str, Sequence[str]]) -> None:
    """Replace the file of the digests in one durable step."""
    write_text(directory / SUMS, sums_text(sums))


def read_sums(directory: Path) -> dict[str, list[str]]:
    """Read the digests of the files of a directory, by name.

    Raises:
        DamageError: the file is missing, or is not as `write_sums` writes it.
    """
    path = directory / SUMS
    try:
        lines = path.read_bytes().decode("ascii").splitlines(keepends=True)
    except (OSError, ValueError) as error:
        raise DamageError(f"{path} is missing or damaged: the files beside it have no checksums.") from error
    sums: dict[str, list[str]] = {}
    for line in lines:
        match = _LINE.fullmatch(line)
        if match is None:
            raise DamageError(f"{path} is damaged: a line of it is not a checksum and the name of a file.")
        sums.setdefault(match[2], []).append(match[1])
    return sums


def sums_faults(directory: Path) -> tuple[int, list[str]]:
    """Compare all files that are listed in a directory.

    Returns:
        Their number, and a sentence for each that is missing or has changed.
    """
    try:
        sums = read_sums(directory)
    except DamageError as error:
        return 0, [str(error)]
    faults = []
    for name, digests in sums.items():
        path = directory / name
        try:
            if path_digest(path) not in digests:
                faults.append(f"{path} has changed since it was written: its checksum differs.")
        except OSError as error:
            faults.append(f"{path} cannot be read ({error.strerror or error}).")
    return len(sums), faults
