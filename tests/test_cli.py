"""The command line, and what makes a function a recipe: mistakes get one line and exit code 2."""

import os
import re
import runpy
import subprocess
import sys
import zipfile
from importlib.metadata import version
from pathlib import Path

import pytest

import ifo_grounding.options  # noqa: F401  (its packages set variables as they are first imported)
from ifo_grounding import cli
from ifo_grounding.cli import recipe_names, recipes_folder
from ifo_grounding.errors import UserError
from ifo_grounding.training import Run

RECIPE = """
import os, signal
from _words import GREETING
from ifo_grounding.cli import recipe_main
from ifo_grounding.errors import UserError

@recipe_main
def main(options):
    if options.task == "fly":
        raise UserError("unknown task 'fly':\\n   choose move or pick")
    if options.task == "interrupt":
        raise KeyboardInterrupt
    if options.task == "end":
        os.kill(os.getpid(), signal.SIGTERM)
    if options.task == "within":
        import torch
        from tensordict import TensorDict
        layer = torch.nn.Linear(1, 1)
        with TensorDict.from_module(layer).to_module(layer):
            raise KeyboardInterrupt
    if options.task == "measure":
        import torch
        from ifo_grounding.report.results import by_scene
        return {"phase1": by_scene(torch.arange(20) > options.seed)}
    if options.task == "bug":
        raise RuntimeError("a bug")
    print(GREETING, options.task, options.imitate.lr, options.seed)

if __name__ == "__main__":
    main()
"""


@pytest.fixture
def recipes(tmp_path, monkeypatch):
    """A folder of recipes with one recipe, ``greet``; the working folder is an empty one."""
    folder = tmp_path / "recipes"
    folder.mkdir()
    (folder / "conf").symlink_to(recipes_folder() / "conf")
    (folder / "greet.py").write_text(RECIPE)
    (folder / "_words.py").write_text("GREETING = 'hello'\n")
    monkeypatch.setattr(cli, "recipes_folder", lambda: folder)
    empty = tmp_path / "empty"
    empty.mkdir()
    monkeypatch.chdir(empty)
    yield folder
    sys.modules.pop("_words", None)


def run(*arguments: str) -> int:
    """Exit code of the command."""
    try:
        cli.main(list(arguments))
    except SystemExit as exit_:
        return int(exit_.code or 0)
    return 0


def test_a_recipe_gets_its_options_and_leaves_nothing_behind(recipes, capsys):
    before = (list(sys.argv), list(sys.path), Path.cwd(), dict(os.environ))
    assert run("run", "greet", "task=pick", "imitate.lr=1", "preset=paper") == 0
    assert capsys.readouterr().out == "hello pick 1.0 0\n"
    assert (list(sys.argv), list(sys.path), Path.cwd(), dict(os.environ)) == before
    assert list(Path.cwd().iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("demoo", "unknown command 'demoo' (did you mean 'demo'?): choose one of 'demo', "),
        ("run", "which recipe? choose one of greet"),
        ("run great", "unknown recipe 'great' (did you mean 'greet'?): choose one of 'greet'"),
        ("run greet tsk=move", "unknown option 'tsk' (did you mean 'task'?): there are "),
        ("run greet --resolve", "--resolve: options are written name=value"),
        ("run greet task=fly", "unknown task 'fly': choose move or pick"),
        ("run greet -m preset=paper,huge", "unknown preset 'huge': choose one of paper, strong"),
    ],
)
def test_a_mistake_gets_one_line_and_code_2(recipes, capsys, arguments, said):
    assert run(*arguments.split()) == 2
    printed = capsys.readouterr()
    assert printed.err.lower().startswith(f"error: {said}".lower())
    assert printed.err.count("\n") == 1 and not printed.out
    assert list(Path.cwd().iterdir()) == []


def test_several_values_run_one_after_the_other(recipes, capsys):
    assert run("run", "greet", "--multirun", "task=move,pick", "seed=0,1", "imitate.lr=0.5") == 0
    assert capsys.readouterr().out.splitlines() == [
        f"hello {task} 0.5 {seed}" for task in ("move", "pick") for seed in (0, 1)
    ]
    assert list(Path.cwd().iterdir()) == []


def test_results_of_several_seeds_end_in_one_table(recipes, capsys):
    assert run("run", "greet", "-m", "task=measure", "seed=4,6", "preset=strong,paper") == 0
    *_, strong, paper = capsys.readouterr().out.splitlines()
    assert strong.split()[:3] == ["measure-strong-few-seed*", "2", "70.0%"]
    assert paper.split()[:3] == ["measure-paper-many-seed*", "2", "70.0%"]
    assert run("run", "greet", "-m", "task=measure", "seed=4,6", "run='n4-n6-${seed}'") == 0
    assert capsys.readouterr().out.splitlines()[-1].split()[:2] == ["n4-n6-*", "2"]


@pytest.mark.parametrize("task", ["interrupt", "end", "within"])
def test_an_interruption_is_no_mistake(recipes, capsys, task):
    assert run("run", "greet", f"task={task}") == 130
    assert capsys.readouterr().err == "interrupted\n"


def test_a_bug_keeps_its_traceback_and_that_of_a_mistake_can_be_asked_for(recipes, monkeypatch):
    with pytest.raises(RuntimeError, match="a bug"):
        cli.main(["run", "greet", "task=bug"])
    monkeypatch.setenv("IFO_GROUNDING_TRACEBACK", "1")
    with pytest.raises(UserError, match="unknown task"):
        cli.main(["run", "greet", "task=fly"])


def test_help_of_a_recipe_lists_its_options(recipes, capsys):
    assert run("run", "greet", "--help") == 0
    printed = capsys.readouterr().out
    assert printed.startswith("greet: options are written name=value")
    assert re.search(r"\n  budget=tiny +to try a pipeline out", printed)
    assert "\n  seed=0 " in printed and "Of all randomness." in printed
    assert run("run", "greet", "task=pick", "--help") == 0
    assert "\n  task=pick " in capsys.readouterr().out
    assert run("run", "greet", "tsk=pick", "--help") == 2


def test_help_of_a_recipe_shows_what_it_reads_and_has_of_its_own(capsys):
    assert run("run", "imitate", "--help") == 0
    printed = capsys.readouterr().out
    assert "\n  imitate.lr=" in printed and "\n  networks.dropout=" in printed
    assert "self_examine" not in printed and "ifo-grounding demo --help" in printed
    assert run("demo", "--help") == 0
    printed = capsys.readouterr().out
    assert printed.startswith("demo: ")
    assert re.search(r"world\.size=6 +Cells along one side", printed)
    assert re.search(r"inverse\.iteration=50 +Steps between", printed)
    assert re.search(r"imitate\.iteration=50\n", printed)  # as of the inverse model, above
    assert run("run", "reproduce", "table=2", "--help") == 0
    printed = capsys.readouterr().out
    assert "\n  table=2 " in printed and "Of the paper: 1, with a success" in printed
    assert run("run", "reproduce", "preset=strong") == 2
    assert run("run", "reproduce", "table=7") == 2
    assert "unknown table 7: choose one of 1, 2, 3, 4" in capsys.readouterr().err


def test_the_package_is_the_command_too(capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["ifo_grounding", "--version"])
    runpy.run_module("ifo_grounding", run_name="__main__")
    assert capsys.readouterr().out.startswith("ifo-grounding ")


def test_help_tells_of_a_new_run_whatever_an_old_one_was_made_with(tmp_path, capsys):
    Run(tmp_path / "run").begin({"level": None, "task": "pick"})
    assert run("demo", f"run={tmp_path / 'run'}", "--help") == 0
    assert "\n  task=move " in capsys.readouterr().out


def test_help_ends_where_its_reader_does():
    command = [sys.executable, str(recipes_folder() / "imitate.py"), "--help"]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True) as process:
        assert process.stdout and process.stderr
        process.stdout.close()
        assert (process.stderr.read(), process.wait()) == ("", cli.CLOSED)


def test_help_and_version(capsys):
    assert run() == run("--help") == run("-h") == run("run", "--help") == 0
    printed = capsys.readouterr().out
    for command in [*cli.COMMANDS, "run"]:
        assert f"\n  {command} " in printed
    assert run("--version") == 0
    assert capsys.readouterr().out == f"ifo-grounding {version('ifo-grounding')}\n"
    assert {recipe for recipe, _ in cli.COMMANDS.values()} <= set(recipe_names())


def test_an_installation_without_recipes_says_so(tmp_path, monkeypatch):
    monkeypatch.setattr(cli, "__file__", str(tmp_path / "a" / "b" / "cli.py"))
    with pytest.raises(UserError, match="install ifo-grounding again"):
        recipes_folder()


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The package as it is installed elsewhere: an unpacked wheel."""
    folder = tmp_path_factory.mktemp("wheel")
    root = Path(__file__).parents[1]
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation"]
    subprocess.run([*command, "--wheel-dir", str(folder), str(root)], check=True)
    with zipfile.ZipFile(next(folder.glob("*.whl"))) as archive:
        archive.extractall(folder / "site")
    return folder / "site"


def test_the_wheel_works_outside_of_the_repository(wheel, tmp_path):
    package = wheel / "ifo_grounding"
    assert (package / "py.typed").is_file()
    assert not list(package.rglob("__pycache__"))
    environment = {**os.environ, "PYTHONPATH": str(wheel)}
    code = "import ifo_grounding.cli as c; print(c.__file__); c.main(['demo', 'taks=move'])"
    command = [sys.executable, "-c", code]
    done = subprocess.run(
        command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert done.stdout.strip() == str(package / "cli.py")
    assert done.returncode == 2
    assert done.stderr.startswith("error: unknown option 'taks' (did you mean 'task'?)")
    listed = {path.name for path in (package / "recipes").rglob("*") if path.is_file()}
    source = {p.name for p in recipes_folder().rglob("*") if p.suffix in (".py", ".yaml")}
    assert listed == source
