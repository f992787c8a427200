"""The command line: one program, and the one place that turns errors into a line on stderr and an exit code.

Exit codes: 0 done; 1 the verdict is negative where a command judges; 2 wrong input or usage; 130 stopped by Ctrl-C
(a study by SIGTERM too).
"""

from __future__ import annotations

import atexit
import gc
import sys
import traceback
import warnings
from collections.abc import Sequence
from typing import Annotated, Any

import typer

import livedeform
from livedeform import outputs
from livedeform.commands import import_, study
from livedeform.commands.calibrate import calibrate
from livedeform.commands.campaign import campaign
from livedeform.commands.compare import compare
from livedeform.commands.demo import demo
from livedeform.commands.diagnose import diagnose
from livedeform.commands.doctor import doctor
from livedeform.commands.export import export
from livedeform.commands.info import info, recover, schema
from livedeform.commands.live import live
from livedeform.commands.new import new
from livedeform.commands.parameters import parameters
from livedeform.commands.play import play
from livedeform.commands.report import report
from livedeform.commands.run import run as run_command
from livedeform.commands.synth import synth
from livedeform.commands.view import view
from livedeform.common.errors import LivedeformError
from livedeform.common.processes import INTERRUPTED, end, terminable

DONE, NEGATIVE, WRONG = 0, 1, 2
LISTS = ("--fit", "--test", "--after", "--repeat")  # options that take several values: --fit a.mcap b.mcap

app = typer.Typer(
    name="livedeform",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog="Errors are one line; --debug adds the traceback. 'livedeform COMMAND --help' has examples.",
)


def _version(asked: bool) -> None:
    if asked:
        typer.echo(f"livedeform {livedeform.__version__}")
        raise typer.Exit


@app.callback()
def livedeform_(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
    debug: Annotated[
        bool, typer.Option("--debug", help="Show the traceback of an error (anywhere on the line).")
    ] = False,
) -> None:
    """How wrong is my soft-tissue model, why, and what do I do about it?"""


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of the console script ``livedeform``."""
    gc.set_threshold(50_000, 20, 20)  # a command keeps most of what it makes, the modules above all
    atexit.register(gc.freeze)  # nor does its end look through all of it for cycles, which took a second
    end(run(sys.argv[1:] if arguments is None else arguments))


def run(arguments: Sequence[str]) -> int:
    """Runs one command; returns its exit code, after one line on stderr if it failed."""
    debug = "--debug" in arguments
    words = repeat_lists([a for a in arguments if a != "--debug"])
    warnings.showwarning = _warn
    try:
        with terminable():
            code = typer.main.get_command(app)(args=words, prog_name="livedeform", standalone_mode=False)
        return code if isinstance(code, int) else DONE
    except LivedeformError as error:
        _complain(str(error), debug)
    except KeyboardInterrupt:
        _complain("stopped", debug)
        return INTERRUPTED
    except BrokenPipeError:  # the reader of our output has gone: head, less
        sys.stderr.close()
        return DONE
    except Exception as error:
        if hasattr(error, "format_message"):  # usage: typer's, or click's under older typers
            _complain(_usage(error), debug)
        elif isinstance(error, OSError) and error.errno in outputs.UNWRITABLE:
            _complain(str(outputs.unwritable(error)), debug)
        else:
            what = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
            _complain(f"internal error, {what}; run it again with --debug and report what it prints", debug)
    return WRONG


def repeat_lists(arguments: Sequence[str]) -> list[str]:
    """``--fit a b`` as ``--fit a --fit b``, which is what the parser wants."""
    out: list[str] = []
    option: str | None = None
    fresh = False  # whether the option itself was the last word
    for word in arguments:
        if word in LISTS:
            option, fresh = word, True
            out.append(word)
        elif word.startswith("-"):
            option = None
            out.append(word)
        else:
            out += [word] if option is None or fresh else [option, word]
            fresh = False
    return out


def _usage(error: Exception) -> str:
    message = " ".join(error.format_message().split()).rstrip(".")  # type: ignore[attr-defined]
    context = getattr(error, "ctx", None)
    command = context.command_path if context is not None else "livedeform"
    return f"{command}: {message[:1].lower() + message[1:]}; see '{command} --help'"


def _warn(message: Warning | str, *_: Any, **__: Any) -> None:
    """A library's warning in one line; where it was raised is of no use to who reads it."""
    print(f"warning: {' '.join(str(message).split())}", file=sys.stderr)


def _complain(line: str, debug: bool) -> None:
    if debug:
        traceback.print_exc()
    prefix = "" if line.startswith("livedeform") else "livedeform: "
    print(prefix + " ".join(line.split()), file=sys.stderr)


app.command()(demo)
app.command("run")(run_command)
for command in (
    new,
    live,
    diagnose,
    compare,
    campaign,
    calibrate,
    synth,
    info,
    view,
    export,
    play,
    report,
    recover,
    schema,
    parameters,
    doctor,
):
    app.command()(command)
app.add_typer(study.app, name="study")
app.add_typer(import_.app, name="import")

if __name__ == "__main__":
    main()
