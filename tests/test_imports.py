"""The layers: which part may import which, read from the source itself."""

import ast
import functools
import graphlib
import importlib
import subprocess
import sys
from pathlib import Path

import pytest

from ifo_grounding import keys

PACKAGE = Path(keys.__file__).parent
ORDER = (
    ("keys", "texts", "errors", "seeding", "files", "machine"),
    ("channels", "cluster", "distinct", "mosaic", "progress"),
    ("world",),
    ("tasks",),
    ("attributes", "modules", "episodes"),
    ("envs",),
    ("data",),
    ("networks", "objectives", "transforms"),
    ("training",),
    ("stats", "evaluation"),
    ("report",),
    ("worlds", "baselines"),
    ("config", "cli"),
    ("playground",),
    ("options", "__main__"),
)
"""The layers of the house: each imports those above it."""
LEARNER = ("networks", "objectives", "transforms", "training")
HIDDEN = {
    "networks": ("world", "envs", "data", "objectives", "transforms"),
    "objectives": ("world", "envs", "data", "networks", "transforms"),
    "transforms": ("world", "envs", "networks", "objectives"),
    "training": ("world", "envs"),
}
"""What a layer does not import although it lies above: siblings, and the truth."""
VOCABULARY = "ifo_grounding.tasks.vocabulary"


def name_of(path: Path) -> tuple[str, ...]:
    parts = ("ifo_grounding", *path.relative_to(PACKAGE).with_suffix("").parts)
    return parts[:-1] if parts[-1] == "__init__" else parts


@functools.cache
def imports_of(path: Path, deferred: bool = True) -> set[str]:
    """Absolute names of every module and member that a file imports.

    Wherever the line stands or, unless ``deferred``, outside of functions and of what only type
    checkers read.
    """
    here = "ifo_grounding." + path.relative_to(PACKAGE).with_suffix("").as_posix().replace("/", ".")
    names: set[str] = set()
    tree = ast.parse(path.read_text())
    late = {
        inner
        for node in ast.walk(tree)
        if isinstance(node, (ast.FunctionDef, ast.If))
        for inner in ast.walk(node)
    }
    for node in ast.walk(tree):
        if not deferred and node in late:
            continue
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


def place(layer: str) -> int:
    return next(number for number, row in enumerate(ORDER) if layer in row)


def layers() -> list[str]:
    entries = (
        path
        for path in PACKAGE.iterdir()
        if path.stem not in ("__init__", "__pycache__", "pretrained")
    )
    return sorted(path.stem for path in entries if path.is_dir() or path.suffix == ".py")


@pytest.mark.parametrize("layer", layers())
def test_a_layer_imports_those_above_it(layer):
    files = sources(layer) or [PACKAGE / f"{layer}.py"]
    late = {
        f"{path.name}: {name}"
        for path in files
        for name in imports_of(path, deferred=False)
        if name.startswith("ifo_grounding.") and (other := name.split(".")[1]) in layers()
        if other != layer and (place(other) > place(layer) or other in HIDDEN.get(layer, ()))
    }
    assert not late


def test_no_module_imports_one_that_imports_it():
    """Also within a package, imports inside of functions left out."""
    files = {".".join(name_of(path)): path for path in PACKAGE.rglob("*.py")}
    graph = {
        name: {
            max((each for each in files if is_under(target, each)), key=len, default="")
            for target in imports_of(path, deferred=False)
        }
        - {name, "", "ifo_grounding"}
        for name, path in files.items()
    }
    # A package's own names are imported through its __init__, which imports its modules.
    graph = {
        name: {each for each in found if not (is_under(name, each) and each != name)}
        for name, found in graph.items()
    }
    assert list(graphlib.TopologicalSorter(graph).static_order())


def test_nothing_imports_another_packages_private_name():
    wrong = [
        f"{path.relative_to(PACKAGE)}: {name}"
        for path in PACKAGE.rglob("*.py")
        for name in imports_of(path)
        if is_under(name, "ifo_grounding") and any(p.startswith("_") for p in name.split("."))
        if path.parent == PACKAGE or name.split(".")[1] != path.relative_to(PACKAGE).parts[0]
    ]
    assert not [each for each in wrong if "__version__" not in each]


def test_no_file_is_longer_than_330_lines():
    root = PACKAGE.parents[1]
    files = [*PACKAGE.rglob("*.py"), *(root / "recipes").rglob("*.py")]
    assert not {path.name: n for path in files if (n := len(path.read_text().splitlines())) > 330}


@pytest.mark.parametrize("layer", LEARNER)
def test_learner_reads_only_the_vocabulary_of_the_tasks(layer):
    wrong = [
        f"{path.name}: {name}"
        for path in sources(layer)
        for name in sorted(imports_of(path))
        if is_under(name, "ifo_grounding.tasks") and not is_under(name, VOCABULARY)
    ]
    assert not wrong


def test_no_learner_knows_the_rivals():
    """They may read actions and step from demonstrations' states, even inside of functions."""
    allowed = {"config.py"}  # of whose options some are theirs
    wrong = [
        f"{path.relative_to(PACKAGE)}: {name}"
        for path in PACKAGE.rglob("*.py")
        if path.parent.name != "baselines" and path.name not in allowed
        for name in imports_of(path)
        if is_under(name, "ifo_grounding.baselines")
    ]
    assert not wrong


def test_the_vocabulary_knows_nothing_of_the_truth():
    names = imports_of(PACKAGE / "tasks" / "vocabulary.py")
    ours = {name for name in names if is_under(name, "ifo_grounding")}
    allowed = tuple(f"ifo_grounding.{name}" for name in ("keys", "texts", "errors", "seeding"))
    assert all(any(is_under(name, module) for module in allowed) for name in ours), ours


def test_the_world_does_not_need_torchrl():
    roots = {name.split(".")[0] for path in sources("world") for name in imports_of(path)}
    assert "torchrl" not in roots
    assert "torch" in roots


@pytest.mark.parametrize("name", [".".join(name_of(p)) for p in sorted(PACKAGE.rglob("*.py"))])
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
    extras = "av datasets h5py huggingface_hub minari minigrid pyarrow pygame"
    names = {name for path in PACKAGE.rglob("*.py") for name in imports_of(path, deferred=False)}
    assert not {name.split(".")[0] for name in names} & {*extras.split()}
