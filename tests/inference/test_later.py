import subprocess
import sys
import threading

from service.inference.later import Later

ASKED_AS_IT_ENDS = """
import threading, time, weakref
from service.inference.later import Later

begun = threading.Event()

def slow():
    begun.set()
    time.sleep(0.3)
    print("ended", flush=True)

class Owner: pass

owner, later = Owner(), Later(slow, 0)
weakref.finalize(owner, later.stop)
later.ask()
begun.wait()
"""


def test_it_is_done_once_however_often_asked() -> None:
    done = threading.Semaphore(0)
    later = Later(done.release, 0.2)
    for _ in range(5):
        later.ask()
    assert done.acquire(timeout=10)
    assert not done.acquire(timeout=0.5)


def test_what_was_stopped_is_not_begun() -> None:
    done = threading.Event()
    later = Later(done.set, 1)
    later.stop()
    later.ask()
    later.stop()
    assert not done.wait(1.5)


def test_what_has_begun_is_waited_for_when_the_process_ends() -> None:
    ended = subprocess.run([sys.executable, "-c", ASKED_AS_IT_ENDS], capture_output=True, text=True, timeout=60)
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, "ended\n", "")
