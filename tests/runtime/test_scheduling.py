"""Who runs first, in processes of their own: it cannot be undone without rights."""

import subprocess
import sys
import textwrap

from cbe_runtime.scheduling import NICE

PRELUDE = """
import os, threading
from cbe_runtime import scheduling
"""


def printed(code: str) -> list[str]:
    program = PRELUDE + textwrap.dedent(code)
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=60,
        check=True,
    )  # fmt: skip
    return done.stdout.split()


def test_threads_started_later_run_first_too_where_it_is_permitted():
    first, process, thread = printed("""
        first = scheduling.run_first()
        seen = []
        thread = threading.Thread(target=lambda: seen.append(os.sched_getscheduler(0)))
        thread.start()
        thread.join()
        print(first, os.sched_getscheduler(0), *seen)
    """)
    assert process == thread
    assert (first == "True") == (process == "1")  # SCHED_FIFO


def test_who_may_not_run_first_is_told_and_goes_on():
    code = """
        import resource
        resource.setrlimit(resource.RLIMIT_RTPRIO, (0, 0))
        if os.getuid() == 0:
            os.setuid(65534)
        print(scheduling.run_first(), os.sched_getscheduler(0))
    """
    assert printed(code) == ["False", "0"]


def test_the_view_beside_yields_to_all():
    code = """
        scheduling.run_first()
        if os.fork() == 0:
            scheduling.run_last()
            print(os.sched_getscheduler(0), os.nice(0), flush=True)
            os._exit(0)
        os.wait()
    """
    assert printed(code) == ["0", str(NICE)]


def test_settling_takes_what_exists_out_of_collections():
    frozen, kept = printed("""
        import gc
        scheduling.settle()
        print(gc.get_freeze_count() > 1000, len(gc.get_objects()) < 1000)
    """)
    assert (frozen, kept) == ("True", "True")
