"""What makes a function a recipe: options through Hydra, mistakes answered with one line."""

from __future__ import annotations

import contextlib
import functools
import inspect
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from ifo_grounding._help import help_text
from ifo_grounding._overrides import check_options
from ifo_grounding.errors import UserError

if TYPE_CHECKING:
    from omegaconf import DictConfig

USAGE_ERROR = 2
INTERRUPTED = 130
CLOSED = 141


@contextlib.contextmanager
def one_line_errors() -> Iterator[None]:
    """Turn a :class:`UserError` into ``error: ...`` on stderr and exit code 2, without a traceback.

    So it does with what the system refuses: a file that cannot be written, a full disk.
    ``HYDRA_FULL_ERROR=1`` in the environment keeps the traceback.
    """
    try:
        yield
    except BrokenPipeError:  # whoever reads what is printed, such as `head`, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(CLOSED) from None
    except (UserError, OSError) as error:
        if os.environ.get("HYDRA_FULL_ERROR") == "1":
            raise
        print("error:", " ".join(str(error).split()), file=sys.stderr)
        raise SystemExit(USAGE_ERROR) from None
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        raise SystemExit(INTERRUPTED) from None


def recipe_main(function: Callable[[DictConfig], object]) -> Callable[[], None]:
    """Decorate the function of a recipe script, which takes the composed options.

    The options come from ``conf/<script name>.yaml`` beside the script and from ``name=value``
    on the command line. An unknown option, a value of the wrong kind and a :class:`UserError` of
    the recipe itself become one line on stderr and exit code 2.

    Example of a whole recipe ``recipes/greet.py``, with ``name: world`` in ``conf/greet.yaml``::

        @recipe_main
        def main(options):
            print("hello", options.name)

        if __name__ == "__main__":
            main()
    """
    script = Path(inspect.getfile(function)).resolve()

    @functools.wraps(function)
    def job(options: DictConfig) -> None:
        from omegaconf import MissingMandatoryValue
        from omegaconf.errors import ConfigAttributeError, ConfigKeyError

        with one_line_errors():
            try:
                function(options)
            except MissingMandatoryValue as error:
                raise UserError(
                    f"option {error.full_key!r} is required: give it a value"
                ) from error
            except (ConfigAttributeError, ConfigKeyError) as error:
                raise UserError(f"option {error.full_key!r} is needed: do not remove it") from error

    @functools.wraps(function)
    def main() -> None:
        with one_line_errors():
            import hydra

            conf = script.parent / "conf"
            flags = check_options(conf, script.stem, sys.argv[1:])
            if flags.help and not flags.multirun:
                print(help_text(conf, script.stem, flags.overrides))
                return
            hydra.main(version_base=None, config_path=str(conf), config_name=script.stem)(job)()

    return main
