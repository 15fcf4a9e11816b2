"""`subprocess.Popen` whose Python programs are forks of `warm_start`: processes without a cold start."""

import os
import select
import subprocess
import sys

from warm_client import exit_code, start_warm


class WarmPopen(subprocess.Popen):
    """A process; what is not Python with a module, a text or a script is started as ever.

    The server forks it, waits for it and says how it ended. Within it, `os.getppid` gives this process.
    """

    server = None
    """The socket of `warm_start`."""

    def _execute_child(self, args, *settings):
        executable, preexec, _, passed, folder, environment = settings[:6]
        pipes, (session, group) = settings[9:15], settings[-2:]
        arguments = [] if isinstance(args, str) else [os.fspath(each) for each in args]
        python, *arguments = arguments or [""]
        program = next((each for each in arguments if each != "-P"), "-")
        is_program = program in ("-m", "-c") or not program.startswith("-")
        if python != sys.executable or not is_program or preexec or executable:
            self._connection = None
            super()._execute_child(args, *settings)
            return
        request = {
            "arguments": arguments,
            "folder": str(folder or os.getcwd()),  # noqa: PTH109
            "environment": dict(os.environ if environment is None else environment),
            "new_session": session,
            "group": group,
            "parent": os.getpid(),
            "passed": list(passed),
        }
        theirs = [pipes[0], pipes[3], pipes[5]]
        descriptors = [end if end >= 0 else standard for standard, end in enumerate(theirs)]
        try:
            self.pid, self._connection = start_warm(self.server, request, [*descriptors, *passed])
            self._child_created = True
        finally:
            self._close_pipe_fds(*pipes)

    def __del__(self, *settings):
        # One that is left alive is not waited for.
        if getattr(self, "_connection", None) is not None:
            self._connection.close()
        super().__del__(*settings)

    def _internal_poll(self, *settings, **named):
        if self._connection is None:
            return super()._internal_poll(*settings, **named)
        if self.returncode is None and self._waitpid_lock.acquire(blocking=False):
            try:
                process, status = self._try_wait(os.WNOHANG)
                if process == self.pid:
                    self._handle_exitstatus(status)
            finally:
                self._waitpid_lock.release()
        return self.returncode

    def _try_wait(self, flags):
        if self._connection is None:
            return super()._try_wait(flags)
        if flags & os.WNOHANG and not select.select([self._connection], [], [], 0)[0]:
            return 0, 0
        code = exit_code(self._connection)
        self._connection.close()
        return self.pid, -code if code < 0 else code << 8
