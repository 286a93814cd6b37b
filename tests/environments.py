"""Install the dependencies of every extra, all the oldest or all the newest, and try each once.

    python tests/environments.py oldest  # each at its lower bound in pyproject.toml
    python tests/environments.py newest  # upper bounds left out: what installs together

Options that follow are pytest's. It needs Python 3.11 or later, as the extra minari does.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

try:
    import tomllib
except ModuleNotFoundError:  # pytest brings it for Python 3.10
    import tomli as tomllib

ROOT = Path(__file__).parents[1]
TRIED = (
    "golden",  # torch
    "envs/test_gymnasium.py",  # gymnasium, pygame, stable-baselines3
    "envs/test_gymnasium_vector.py",
    "data/test_babyai.py",
    "data/test_codec.py",  # hypothesis
    "data/test_huggingface.py",
    "data/test_lerobot.py",  # datasets, pyarrow, pandas, av
    "data/test_minari.py",
    "data/test_pictures.py",  # av, pillow
    "networks/test_saving.py",  # safetensors, huggingface_hub
    "objectives/test_losses.py",  # tensordict
    "report/test_page.py",  # jinja2, matplotlib
    "test_cli.py",  # hydra
    "test_environments.py",
    "test_imports.py",
    "test_stats.py",  # scipy
    "training/test_run.py",  # tensorboard, wandb
    "transforms/test_algorithms.py",  # torchrl
)
SETTINGS = {"OMP_NUM_THREADS": "1", "NO_MKDOCS_2_WARNING": "1"}
TOOLS = (
    "mypy --version",
    "tensorboard.main --version",
    "playwright --version",
    "pre_commit validate-config",
    "ruff --version",
)


def requirements() -> list[str]:
    """Return what pyproject.toml asks for, to build and with every extra."""
    content = tomllib.loads((ROOT / "pyproject.toml").read_text())
    build, project = content["build-system"]["requires"], content["project"]
    groups = (build, project["dependencies"], *project["optional-dependencies"].values())
    return [each for group in groups for each in group if not each.startswith(project["name"])]


def oldest(requirement: str) -> str:
    """Return a requirement of the lowest version alone.

    >>> oldest("minigrid>=3,<4; python_version >= '3.11'")
    "minigrid==3; python_version >= '3.11'"
    """
    return re.sub(r">=([\w.]+)[^;]*", r"==\1", requirement, count=1)


def newest(requirement: str) -> str:
    """Return a requirement without its upper bound.

    >>> newest("minigrid>=3,<4; python_version >= '3.11'")
    "minigrid>=3; python_version >= '3.11'"
    """
    return re.sub(r",<[^;]*", "", requirement)


def main(which: str, *options: str) -> None:
    """Make or update ``.venv-oldest`` or ``.venv-newest`` and run what uses its packages."""
    folder = ROOT / f".venv-{which}"
    subprocess.run([sys.executable, "-m", "venv", folder], check=True)
    failed = []

    def run(*words: str) -> None:
        command = [str(folder / "bin" / "python"), "-m", *words]
        print("+", *command, flush=True)
        if subprocess.run(command, cwd=ROOT, env=os.environ | SETTINGS).returncode:
            failed.append(" ".join(words))

    asked = map({"oldest": oldest, "newest": newest}[which], requirements())
    run("pip", "install", "--quiet", "--upgrade", "--upgrade-strategy", "eager", *asked)
    if failed:
        sys.exit("these do not install together")
    run("pip", "install", "--quiet", "--no-deps", "--no-build-isolation", ".")
    run("pip", "list")
    for tool in TOOLS:
        run(*tool.split())
    run("mkdocs", "build", "--quiet", "--strict", "--site-dir", str(folder / "site"))
    run("pytest", "--quiet", *(f"tests/{name}" for name in TRIED), *options)
    sys.exit("\n".join(["failed:", *failed]) if failed else 0)


if __name__ == "__main__":
    main(*sys.argv[1:])
