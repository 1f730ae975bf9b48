"""The ``neumat`` command: arguments in, calls out, errors as one line. What it does lives in the packages it calls."""

import sys

from warp_neumat.cli import assets, render
from warp_neumat.cli.common import Usage, app

__all__ = ["app", "assets", "main", "render"]


def main(arguments: list[str] | None = None) -> None:
    """Run the command line; a user's mistake ends in one line on stderr and exit code 1, a wrong option in 2."""
    arguments = sys.argv[1:] if arguments is None else arguments
    debug = "--debug" in arguments  # before or after the command
    try:
        code = app([a for a in arguments if a != "--debug"] if debug else arguments, standalone_mode=False)
        if code == 130:  # the parser's word for Ctrl-C
            raise KeyboardInterrupt
        if code:
            sys.exit(code)
    except Exception as error:
        if debug:
            raise
        if hasattr(error, "format_message"):  # the parser's own: unknown command or option, missing argument
            if not arguments:
                return  # the help has been printed
            print(f"neumat: {' '.join(error.format_message().split())}; see neumat --help", file=sys.stderr)
            sys.exit(error.exit_code)
        text = " ".join(str(error).split()) or type(error).__name__
        print(f"neumat: {text}", file=sys.stderr)
        sys.exit(2 if isinstance(error, Usage) else 1)
    except KeyboardInterrupt:
        print("neumat: interrupted", file=sys.stderr)
        sys.exit(130)
