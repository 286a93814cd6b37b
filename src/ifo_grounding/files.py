"""Writing files so that a reader sees the old one or the new one, never half of one."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import math
import os
import re
import shutil
import uuid
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

from ifo_grounding.errors import UserError

TAKEN = (errno.ENOTEMPTY, errno.EEXIST)
"""Another writer's folder has come in the meantime."""
WRITERS = 20
"""How often a folder is tried to be replaced that others replace, too."""

LEFT = re.compile(r"\..+\.[0-9a-f]{8}\.(tmp|old)")
"""Names of what is being written, and of what it takes the place of."""


def home() -> Path:
    """Folder of runs and data: ``$IFO_GROUNDING_HOME``, or ``~/.cache/ifo-grounding``."""
    return Path(os.environ.get("IFO_GROUNDING_HOME", "~/.cache/ifo-grounding")).expanduser()


def regular_file(path: Path) -> Path:
    """Return a path that is read next; what is no regular file, as a pipe, is an OSError."""
    if not path.is_file():
        raise OSError(f"{path} is no regular file")
    return path


def unwritable(path: Path, reason: str) -> UserError:
    """Return what to say where a file cannot be written, such as on a full disk."""
    free = f"{shutil.disk_usage(path.parent).free / 1e6:,.0f} MB are free there"
    return UserError(
        f"{path} cannot be written ({reason}; {free}): make room, and run the same again to go on"
    )


@contextlib.contextmanager
def atomic_write(path: str | Path) -> Iterator[Path]:
    """Yield a temporary path beside ``path`` that takes its name when the block ends well.

    The temporary path may be written as a file or made a folder. It is removed if the block raises.

    Raises:
        UserError: where ``path`` is the current folder or holds it, which would be replaced.
    """
    path = Path(os.path.realpath(path))  # what a link points to, not the link
    path.parent.mkdir(parents=True, exist_ok=True)
    with contextlib.suppress(FileNotFoundError):
        if Path.cwd().is_relative_to(path):
            raise UserError(f"{path} is the current folder or holds it: name another one")
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.tmp")
    try:
        yield temporary
        if temporary.is_dir() and not path.is_file():
            _replace_folder(temporary, path)
        else:
            os.replace(temporary, path)
    finally:
        if temporary.is_dir():
            shutil.rmtree(temporary)
        else:
            temporary.unlink(missing_ok=True)


def remove_leftovers(*folders: Path) -> None:
    """Remove what killed writers left in folders, and nothing of another name."""
    for left in (path for folder in folders for path in folder.glob(".*")):
        if LEFT.fullmatch(left.name):
            is_folder = left.is_dir() and not left.is_symlink()
            shutil.rmtree(left) if is_folder else left.unlink(missing_ok=True)


def _replace_folder(temporary: Path, path: Path) -> None:
    """Give a folder the name of another, which goes; of several writers the last one stays."""
    retired = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.old")
    retired.mkdir()
    try:
        for patience in range(WRITERS, -1, -1):
            with contextlib.suppress(FileNotFoundError):
                os.replace(path, retired / str(patience))
            try:
                os.replace(temporary, path)
                return
            except OSError as error:
                if not patience or error.errno not in TAKEN:
                    raise
    finally:
        if temporary.exists() and not path.exists():  # interrupted: the old one comes back
            for old in [*retired.iterdir()][-1:]:
                os.replace(old, path)
        shutil.rmtree(retired, ignore_errors=True)


def check_folder(name: str, path: Path) -> None:
    """Refuse what is, or lies in, a file.

    >>> check_folder("results", Path("anything"))
    """
    for part in (path, *path.parents):
        if part.exists() and not part.is_dir():
            raise UserError(f"{name}={path}: {part} is a file; name a folder")


def write_json(path: str | Path, content: Any) -> None:
    """Write ``content`` as indented JSON, atomically; numbers that are not finite become null."""
    text = json.dumps(_finite(content), indent=2, sort_keys=True, allow_nan=False)
    with atomic_write(path) as temporary:
        temporary.write_text(text + "\n")


def _finite(content: Any) -> Any:
    if isinstance(content, float) and not math.isfinite(content):
        return None
    if isinstance(content, Mapping):
        return {key: _finite(value) for key, value in content.items()}
    return [_finite(value) for value in content] if isinstance(content, (list, tuple)) else content


def read_json(path: str | Path, kind: Any = object, keys: Collection[str] = ()) -> Any:
    """Read JSON, or refuse what is missing, damaged, no ``kind`` or a dict without ``keys``."""
    try:
        path = Path(path)
        content = json.loads((regular_file(path) if path.exists() else path).read_text())
        if not isinstance(content, kind) or any(key not in content for key in keys):
            held = f" with {', '.join(keys)}" if keys else ""
            raise ValueError(f"it holds no {kind.__name__}{held}")
        return content
    except FileNotFoundError:
        raise UserError(f"{path} does not exist") from None
    except OSError as error:
        raise UserError(f"{path} cannot be read ({error})") from None
    except (ValueError, RecursionError) as error:  # no JSON, no text, too deep or too long
        raise UserError(f"{path} is not valid JSON ({error}): delete it or restore it") from None


def write_record(path: str | Path, content: Mapping[str, Any]) -> None:
    """Write a dict as JSON with a digest of it, by which :func:`read_record` notices changes."""
    content = json.loads(json.dumps(_finite(content)))  # as it will be read
    write_json(path, {**content, "digest": _digest(content)})


def read_record(path: str | Path) -> dict[str, Any]:
    """Read what :func:`write_record` wrote, or refuse what was changed since."""
    content: dict[str, Any] = read_json(path, dict, ["digest"])
    if content.pop("digest") != _digest(content):
        raise UserError(f"{path} was changed since it was written: delete it or restore it")
    return content


def _digest(content: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]
