"""Turn the errors of a command into one line and an exit status."""

import contextlib
import functools
import os
import signal
import sys
from collections.abc import Callable
from typing import ParamSpec

from gasil_envs.user_code import in_a_line
from gasil_jax import cli
from gasil_jax.errors import InputError
from gasil_jax.host.interruption import Interrupted

P = ParamSpec("P")


class HelpShown(SystemExit):
    """Ends a command that has printed its help or its version."""


def reports_errors(main: Callable[P, int]) -> Callable[P, int]:
    """Decorate a command's `main`: print its errors and return their exit status.

    The status is 1 if a folder or file can't be read or written, or if a program that
    it started failed; 2 for bad input, which includes that the user's own code calls
    `sys.exit`; and 128 plus the signal's number if it was interrupted, or if nobody
    reads its output to the end. Without an error it is what `main` returns.
    """

    @functools.wraps(main)
    def reporting(*args: P.args, **kwargs: P.kwargs) -> int:
        if signal.getsignal(signal.SIGINT) is cli.quit_at_once:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        try:
            return main(*args, **kwargs)
        except BrokenPipeError:
            # `head` reads a few lines only. Python would still try to write the rest.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 128 + signal.SIGPIPE
        except (InputError, OSError) as error:
            # A name may hold a line break.
            print(*f"error: {error}".splitlines(), sep=r"\n", file=sys.stderr)
            return 2 if isinstance(error, InputError) else 1
        except HelpShown:
            raise
        except SystemExit as exit_:
            why = f"your own code ended the program: {in_a_line(exit_)}"
            print(f"error: {why}", file=sys.stderr)
            return 2
        except Interrupted as interrupted:
            print(interrupted, *interrupted.__notes__, sep="\n", file=sys.stderr)
            return 128 + interrupted.signal
        # Ctrl-C outside of training, or for the second time during it.
        except KeyboardInterrupt:
            print("interrupted", file=sys.stderr, flush=True)
            if cli.IS_PROGRAM:
                # Python's own end would wait for threads, of which one may compile.
                with contextlib.suppress(OSError):
                    sys.stdout.flush()
                os._exit(128 + signal.SIGINT)
            return 128 + signal.SIGINT

    return reporting
