"""The layers: which part may import which, read from the source itself."""

from __future__ import annotations

import ast
import importlib
import subprocess
import sys
from pathlib import Path

import pytest

from ifo_grounding import keys

PACKAGE = Path(keys.__file__).parent
LEARNER = ("networks", "objectives", "transforms", "training")
FORBIDDEN = {
    "world": ("tasks", "envs", "data", *LEARNER, "evaluation", "report"),
    "tasks": ("envs", "data", *LEARNER, "evaluation", "report"),
    "envs": ("data", *LEARNER, "evaluation", "report"),
    "data": (*LEARNER, "evaluation", "report"),
    "networks": ("world", "envs", "objectives", "transforms", "training", "evaluation", "report"),
    "objectives": ("world", "envs", "networks", "transforms", "training", "evaluation", "report"),
    "transforms": ("world", "envs", "networks", "objectives", "training", "evaluation", "report"),
    "training": ("world", "envs", "evaluation", "report"),
    "evaluation": ("training", "report"),
}
VOCABULARY = "ifo_grounding.tasks.vocabulary"


def imports_of(path: Path) -> set[str]:
    """Absolute names of every module and member that a file imports, wherever the line stands."""
    here = "ifo_grounding." + path.relative_to(PACKAGE).with_suffix("").as_posix().replace("/", ".")
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = ".".join(here.split(".")[: -node.level]) if node.level else ""
            module = ".".join(filter(None, (base, node.module)))
            names.update(f"{module}.{alias.name}" for alias in node.names)
    return names


def is_under(name: str, package: str) -> bool:
    return name == package or name.startswith(package + ".")


def sources(layer: str) -> list[Path]:
    return sorted((PACKAGE / layer).rglob("*.py"))


@pytest.mark.parametrize("layer", FORBIDDEN)
def test_layer_imports_nothing_forbidden(layer):
    assert sources(layer), f"{layer} is empty"
    wrong = [
        f"{path.name}: {name}"
        for path in sources(layer)
        for name in sorted(imports_of(path))
        for other in FORBIDDEN[layer]
        if is_under(name, f"ifo_grounding.{other}")
    ]
    assert not wrong


@pytest.mark.parametrize("layer", LEARNER)
def test_learner_reads_only_the_vocabulary_of_the_tasks(layer):
    wrong = [
        f"{path.name}: {name}"
        for path in sources(layer)
        for name in sorted(imports_of(path))
        if is_under(name, "ifo_grounding.tasks") and not is_under(name, VOCABULARY)
    ]
    assert not wrong


def test_the_vocabulary_knows_nothing_of_the_truth():
    names = imports_of(PACKAGE / "tasks" / "vocabulary.py")
    ours = {name for name in names if is_under(name, "ifo_grounding")}
    allowed = ("ifo_grounding.keys", "ifo_grounding.errors", "ifo_grounding.seeding")
    assert all(any(is_under(name, module) for module in allowed) for name in ours), ours


def test_the_world_does_not_need_torchrl():
    roots = {name.split(".")[0] for path in sources("world") for name in imports_of(path)}
    assert "torchrl" not in roots
    assert "torch" in roots


def test_the_reader_of_imports_sees_every_form(tmp_path, monkeypatch):
    monkeypatch.setitem(globals(), "PACKAGE", tmp_path)
    path = tmp_path / "networks" / "sample.py"
    path.parent.mkdir()
    path.write_text(
        "import ifo_grounding.world\n"
        "from ifo_grounding import evaluation\n"
        "def late():\n    from ..tasks.goals import achieved\n"
        "from . import heads\n"
    )
    assert imports_of(path) == {
        "ifo_grounding.world",
        "ifo_grounding.evaluation",
        "ifo_grounding.tasks.goals.achieved",
        "ifo_grounding.networks.heads",
    }


def modules() -> list[str]:
    names = []
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
        names.append(".".join(parts[:-1] if parts[-1] == "__init__" else parts))
    return names


@pytest.mark.parametrize("name", modules())
def test_module_is_documented_and_exports_what_it_has(name):
    module = importlib.import_module(name)
    assert module.__doc__, f"{name} has no docstring"
    for public in getattr(module, "__all__", ()):
        assert hasattr(module, public), f"{name}.__all__ names {public}, which does not exist"


def test_keys_are_distinct_and_documented():
    names = [name for name in vars(keys) if name.isupper()]
    strings = [value for name in names if isinstance(value := getattr(keys, name), str)]
    assert len(strings) == len(set(strings))
    assert len(strings) >= 12
    assert keys.ACTIONS == ("U", "R", "D", "L", "P", "S")
    assert (keys.N_ACTIONS, keys.STOP, keys.INSTRUCTION_LENGTH) == (6, 5, 16)


def test_the_command_starts_without_torch():
    code = "import sys, ifo_grounding.cli; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_extras_are_imported_only_when_they_are_used():
    extras = ("av", "datasets", "h5py", "huggingface_hub", "imageio", "minari", "pyarrow", "pygame")
    code = f"import sys, ifo_grounding.data; sys.exit(str({set(extras)} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], check=False, capture_output=True, text=True)
    assert done.stderr.strip() == "set()"
