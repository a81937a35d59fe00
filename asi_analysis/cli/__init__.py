"""
The `asi` command: parses the command line, calls the Python API, prints the result.

Modules are imported when a command needs them. A new command is one function with @command in the
module of its group; exceptions become exit statuses (see `main`).
"""

import io
import os
import sys
import warnings
from pathlib import Path
from typing import Any

import typer

# The matrices are small: threads of the linear algebra only wait for each other (--jobs takes
# processes). Set before numpy is imported.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

# Importing a group adds its commands, in the order of the help.
from asi_analysis.cli import bags, gap, limit_cycles, paper, tuning, viewing  # noqa: F401
from asi_analysis.cli.interrupt import end_while_compiling
from asi_analysis.cli.options import app as app
from asi_analysis.errors import InputError
from asi_common.executable import only_this_thread_ends
from asi_common.writable import choose_folder


def main() -> int:
    """
    Run the command; return the exit status.

    0: answered; 1: a check or a run failed; 2: wrong input or call (InputError, or a file that
    cannot be read or written), with one line on stderr; 130: Ctrl-C.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):    # a file name may be no text
            stream.reconfigure(errors='backslashreplace')
    choose_folder('MPLCONFIGDIR', Path(os.environ.get('XDG_CONFIG_HOME') or '~/.config')
                  / 'matplotlib')
    warnings.showwarning = lambda message, *_: _say(str(message))
    # The ClickException of typer's own copy of click.
    click_exception: Any = typer.BadParameter.__mro__[2]
    try:
        end_while_compiling()
        status = app(prog_name='asi', standalone_mode=False) or 0
        return _interrupted() if status == 130 else status   # typer's, of Ctrl-C
    except KeyboardInterrupt:       # while typer builds the commands
        return _interrupted()
    except InputError as error:
        return _fail(str(error), 2)
    except ValueError as error:
        from asi_common.parameter import ParameterError
        if not isinstance(error, ParameterError):
            raise
        return _fail(str(error), 2)
    except MemoryError:
        return _fail('there is not enough memory for this', 2)
    except OSError as error:
        return _fail(f'{error.filename}: {error.strerror}' if error.filename else str(error), 2)
    except RuntimeError as error:
        return _fail(str(error), 1)
    except click_exception as error:
        message = error.format_message().rstrip('.')
        where = error.ctx.command_path if getattr(error, 'ctx', None) else 'asi'
        # Called without arguments, a command has printed its help.
        return _fail(f'{message} (see {where} --help)', 2) if message else 2


def _interrupted() -> int:
    only_this_thread_ends()     # the one that watches for Ctrl-C while numba compiles says it too
    return _fail('interrupted', 130)


def _fail(text: str, status: int) -> int:
    _say(text)
    return status


def _say(text: str) -> None:
    """Print one line on stderr; a file name may hold line ends and codes of the terminal."""
    line = ' '.join(text.split())
    print('asi: ' + ''.join(each if each.isprintable() else repr(each)[1:-1] for each in line),
          file=sys.stderr)
