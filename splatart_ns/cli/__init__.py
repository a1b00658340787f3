"""Gaussian splats of articulated objects that can be posed: fit them to images, render and evaluate them."""

from __future__ import annotations

import os
import re
import sys
import warnings

from splatart_ns.machine import CALM_THREADS

os.environ.update({**CALM_THREADS, **os.environ})

import tyro

from splatart_ns.cli.batch import Batch, Shards
from splatart_ns.cli.bundle import Evaluate, Export, View
from splatart_ns.cli.capture import Check, Import, Labels, Segment, Synth
from splatart_ns.cli.demo import Demo
from splatart_ns.cli.fit import Fit
from splatart_ns.cli.render import Render
from splatart_ns.errors import DISK_ERRORS, InputError

_COMMANDS = {"fit": Fit, "render": Render, "view": View, "eval": Evaluate, "check": Check, "import": Import}
_COMMANDS |= {"labels": Labels, "segment": Segment}
_COMMANDS |= {"batch": Batch, "shards": Shards, "export": Export, "synth": Synth, "demo": Demo}


def main() -> None:
    """Run the command line. A user's mistake gets one sentence and exit code 2."""
    sys.stdout.reconfigure(errors="backslashreplace")  # file names need not be UTF-8
    # Nerfstudio's own, which its users cannot mend.
    warnings.filterwarnings("ignore", category=FutureWarning)
    warnings.filterwarnings("ignore", message="Converting a tensor with requires_grad=True")
    try:
        _run()
    except BrokenPipeError:  # as of `splatart check CAPTURE | head`
        _print_no_more()
        raise SystemExit(141) from None
    except InputError as error:
        message = str(error)
        print(f"error: {message}" + ("" if message.endswith(".") else "."), file=sys.stderr)
        raise SystemExit(2) from None
    except OSError as error:
        if error.filename is not None:
            mend = "check the path, its permissions and the space on the disk"
            print(f"error: {error.filename}: cannot be read or written ({error.strerror}); {mend}.", file=sys.stderr)
        elif error.errno in DISK_ERRORS:
            _print_no_more()
            mend = "check the space on the disk, also where the output goes"
            print(f"error: A file cannot be written ({error.strerror}); {mend}.", file=sys.stderr)
        else:
            raise
        raise SystemExit(2) from None
    except (KeyboardInterrupt, SystemError) as error:
        if not _is_interrupt(error):
            raise
        print("Interrupted. An unfinished fit or batch goes on when it is started again.", file=sys.stderr)
        raise SystemExit(130) from None


def _run() -> None:
    # Shells leave a ~ in quotes, and after --data=, as it is.
    arguments = [re.sub("^(--[a-z-]+=)?(~.*)", _with_home, argument, flags=re.DOTALL) for argument in sys.argv[1:]]
    try:
        tyro.extras.subcommand_cli_from_dict(_COMMANDS, prog="splatart", description=__doc__, args=arguments).run()
    except SystemExit:
        sys.stdout.flush()
        raise
    sys.stdout.flush()


def _with_home(argument: re.Match[str]) -> str:
    return (argument[1] or "") + os.path.expanduser(argument[2])


def _is_interrupt(error: BaseException | None) -> bool:
    """Whether it is Ctrl-C, or what numba makes of it while a kernel returns: SystemErrors on top."""
    while isinstance(error, SystemError):
        error = error.__cause__ or error.__context__
    return isinstance(error, KeyboardInterrupt)


def _print_no_more() -> None:
    """Let what is left to print, which has nowhere to go, vanish."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
