"""Last step before the command of a run: makes the operating system end the command together with its worker.

A worker that is killed cannot end its command, which would then write into the same folder as the next start of the
run. Arguments: process id of the worker, then the command. Uses the standard library only; Linux has this function,
other systems rely on the lock of the run.
"""

import ctypes
import os
import signal
import sys

_PR_SET_PDEATHSIG = 1  # linux/prctl.h

if __name__ == "__main__":
    worker, *command = sys.argv[1:]
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != int(worker):  # the worker ended before the line above
        sys.exit("the worker of the run has ended")
    signal.signal(signal.SIGUSR2, signal.SIG_IGN)  # announces a time limit to all processes of a job; the worker acts
    os.execv(command[0], command)
