"""A child process that ends with its parent, however the parent ends and whatever the child computes meanwhile.

The two share a pipe that nobody writes to. When the parent is gone its end closes, and the kernel sends the child a signal; no thread of the child has to
wake for that, which it could not while bundle adjustment holds Python's global lock.
"""

from __future__ import annotations

import fcntl
import os
import select
import signal
import threading


class Lifeline:
    """The parent's end. The child is given `fd` (`pass_fds` of Popen) and calls `end_with_parent`."""

    def __init__(self) -> None:
        self.fd, self._ours = os.pipe()  # neither is inherited by accident: a stranger that held `_ours` would keep the child alive

    def handed_over(self) -> None:
        """The child has been started: this process no longer needs the child's end."""
        os.close(self.fd)

    def cut(self) -> None:
        """End the child if it still runs; can be called once."""
        os.close(self._ours)


def end_with_parent(fd: int) -> None:
    """Have this process killed as soon as the other end of a pipe or socket closes that nothing is written to."""
    if hasattr(fcntl, "F_SETSIG"):
        fcntl.fcntl(fd, fcntl.F_SETOWN, os.getpid())
        fcntl.fcntl(fd, fcntl.F_SETSIG, int(signal.SIGKILL))
        fcntl.fcntl(fd, fcntl.F_SETFL, fcntl.fcntl(fd, fcntl.F_GETFL) | os.O_ASYNC)
        if select.select([fd], [], [], 0.0)[0]:  # it has closed before
            os.kill(os.getpid(), signal.SIGKILL)
    else:  # macOS has no choice of the signal; a thread sees the end once the lock is free
        threading.Thread(target=_wait, args=(fd,), daemon=True, name="lifeline").start()


def _wait(fd: int) -> None:
    select.select([fd], [], [])
    os.kill(os.getpid(), signal.SIGKILL)
