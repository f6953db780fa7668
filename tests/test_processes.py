"""What comes of processes that crash, hang, are silent or talk nonsense."""

import os
import resource
import time
from collections.abc import Callable

import psutil
import pytest
from asked_process import CRASH, HANG, SILENCE, answering, running

from mpmcli.processes.questions import Question, Reply, ask, ask_each, module_command

# Seconds; what is to end in time ends in a small part of it, what is to be late never does.
LONG, SHORT = 60.0, 0.3


def reply_of(code: str, timeout: float = LONG, **environment: str | None) -> Reply:
    return ask(Question(running(code), timeout, environment))


def is_there(number: int) -> bool:
    """Whether a process is running; one that has ended and was not waited for does not count."""
    try:
        return psutil.Process(number).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


def wait_until(happened: Callable[[], bool]) -> None:
    deadline = time.monotonic() + LONG
    while not happened() and time.monotonic() < deadline:
        time.sleep(0.01)
    assert happened()


@pytest.mark.parametrize(
    ("code", "fault"),
    [
        (answering('{"a": 1}'), ""),
        (CRASH, "died by SIGSEGV"),
        (answering('{"a": 1}') + "import sys\nsys.stdout.flush()\n" + CRASH, "died by SIGSEGV"),
        ("raise SystemExit(3)", "exited with 3"),
        (SILENCE, "gave no answer"),
        (answering("[1, 2]") + answering("Segmentation fault"), "gave no answer"),
    ],
)
def test_each_ending_has_its_name(code, fault):
    assert reply_of(code).fault == fault


def test_one_that_hangs_is_ended():
    reply = reply_of("print('{\"a\": 1}', flush=True)\n" + HANG, SHORT)
    assert reply.fault == "took longer than 0.3 s"


def test_a_program_that_is_not_there_is_a_fault_and_no_error():
    assert ask(Question(["/nowhere/python"], LONG)).fault.startswith("could not be started: ")


def test_answers_are_joined_and_what_else_is_said_is_left_out():
    code = answering('{"a": 1, "b": 1}') + answering("a library says hello") + answering('{"b": 2}')
    assert reply_of(code).answer == {"a": 1, "b": 2}
    assert reply_of("import sys\nsys.stderr.write('oh')\nraise SystemExit(1)").complaint == "oh"


def test_much_talk_blocks_nothing():
    assert reply_of("print('x' * 10**7)\nprint('{\"a\": 1}')") == Reply({"a": 1}, "", "")


def test_variables_are_added_and_taken_away(monkeypatch):
    monkeypatch.setenv("MPMCLI_TEST_OLD", "old")
    code = "import json, os\nprint(json.dumps({key: os.environ.get('MPMCLI_TEST_' + key) for key in ('OLD', 'NEW')}))"
    assert reply_of(code, MPMCLI_TEST_OLD=None, MPMCLI_TEST_NEW="new").answer == {"OLD": None, "NEW": "new"}


def test_replies_keep_the_order_of_the_questions_and_the_number_at_a_time(tmp_path):
    """Each writes down who else is there: never more than two; the first is the last to end."""
    code = (
        "import json, os, sys, time\n"
        f"place = {str(tmp_path)!r}\n"
        "open(f'{place}/{os.getpid()}', 'w').close()\n"
        "others = len(os.listdir(place))\n"
        "time.sleep(float(sys.argv[1]))\n"
        "os.remove(f'{place}/{os.getpid()}')\n"
        "print(json.dumps({'others': others, 'name': sys.argv[1]}))\n"
    )
    waits = ["0.5", "0.0", "0.01", "0.02"]
    replies = list(ask_each([Question([*running(code), wait], LONG) for wait in waits], at_once=2))
    assert [reply.answer["name"] for reply in replies] == waits
    assert max(reply.answer["others"] for reply in replies) <= 2


def test_processes_are_ended_with_those_that_they_started_when_nobody_asks_any_more(tmp_path):
    told = tmp_path / "numbers"
    late = (
        "import os, subprocess, sys\n"
        f"process = subprocess.Popen([sys.executable, '-c', {HANG!r}])\n"
        f"with open({str(told)!r}, 'w') as file: file.write(f'{{os.getpid()}} {{process.pid}} all')\n"
    )
    questions = [Question(running(code), LONG, leads_a_group=True) for code in (SILENCE, late + HANG)]
    replies = ask_each(questions, at_once=2)
    next(replies)
    wait_until(lambda: told.exists() and told.read_text().endswith("all"))
    numbers = [int(word) for word in told.read_text().split()[:2]]
    assert all(is_there(number) for number in numbers)
    replies.close()
    wait_until(lambda: not any(is_there(number) for number in numbers))


def test_one_of_ours_leaves_no_core_and_keeps_stdout_to_itself():
    code = (
        "import os, resource\n"
        "from mpmcli.processes.questions import answering\n"
        "hard = resource.getrlimit(resource.RLIMIT_CORE)[1]\n"
        "resource.setrlimit(resource.RLIMIT_CORE, (hard, hard))\n"
        "with answering() as answer:\n"
        '    print(\'{"said": "by a library"}\', flush=True)\n'
        "    os.write(1, b'{\"written\": 1}\\n')\n"
        "    answer(core=resource.getrlimit(resource.RLIMIT_CORE)[0])\n"
    )
    command = module_command("mpmcli")
    reply = ask(Question([*command[: command.index("-m")], "-c", code], LONG))
    assert reply.answer == {"core": 0}
    assert "by a library" in reply.complaint


def test_modules_of_the_current_directory_are_not_taken_for_ours(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "json.py").write_text("raise SystemExit('the wrong one')")
    reply = ask(Question([*module_command("json.tool"), os.devnull], LONG))
    assert "the wrong one" not in reply.complaint


def test_the_limit_of_this_process_stays():
    before = resource.getrlimit(resource.RLIMIT_CORE)
    reply_of(answering("{}"))
    assert resource.getrlimit(resource.RLIMIT_CORE) == before
