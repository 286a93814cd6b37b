"""The command line, and what makes a function a recipe: mistakes get one line and exit code 2."""

from __future__ import annotations

import itertools
import os
import re
import shutil
import subprocess
import sys
import zipfile
from importlib.metadata import version
from pathlib import Path

import pytest

from ifo_grounding import _folder, cli
from ifo_grounding._folder import recipes_folder
from ifo_grounding._overrides import check_options
from ifo_grounding.errors import UserError

RECIPE = """
from _words import GREETING
from ifo_grounding.cli import recipe_main
from ifo_grounding.errors import UserError

@recipe_main
def main(options):
    if options.task == "fly":
        raise UserError("unknown task 'fly':\\n   choose move or pick")
    if options.task == "interrupt":
        raise KeyboardInterrupt
    if options.task == "bug":
        raise RuntimeError("a bug")
    if options.task == "missing":
        options.folder
    print(GREETING, options.task, options.nested.rate, options.width)

if __name__ == "__main__":
    main()
"""
OPTIONS = """
defaults:
  - _hydra
  - preset: strong
  - _self_
task: move
steps: 3
flag: true
folder: ???
name: ${task}-run
limit: null
sizes: [1, 2]
nested:
  rate: 0.5  # how fast
"""
FULL_ERROR = "HYDRA_FULL_ERROR"


@pytest.fixture
def recipes(tmp_path, monkeypatch):
    """A folder of recipes with one recipe, ``greet``; the working folder is an empty one."""
    folder = tmp_path / "recipes"
    (folder / "conf" / "preset").mkdir(parents=True)
    shutil.copy(recipes_folder() / "conf" / "_hydra.yaml", folder / "conf")
    (folder / "greet.py").write_text(RECIPE)
    (folder / "_words.py").write_text("GREETING = 'hello'\n")
    (folder / "conf" / "greet.yaml").write_text(OPTIONS)
    for name, width in (("strong", 64), ("paper", 32)):
        text = f"# @package _global_\nwidth: {width}\n"
        (folder / "conf" / "preset" / f"{name}.yaml").write_text(text)
    monkeypatch.setattr(_folder, "recipes_folder", lambda: folder)
    monkeypatch.delenv(FULL_ERROR, raising=False)
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
    assert run("run", "greet", "task=pick", "nested.rate=1", "preset=paper") == 0
    assert capsys.readouterr().out == "hello pick 1 32\n"
    assert (list(sys.argv), list(sys.path), Path.cwd(), dict(os.environ)) == before
    assert list(Path.cwd().iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["tsk=move"], "unknown option 'tsk' (did you mean 'task'?): there are preset, width, "),
        (["nested.rat=1"], "unknown option 'nested.rat' (did you mean 'rate'?): 'nested' has rate"),
        (["task.x=1"], "unknown option 'task.x': 'task' has no options of its own"),
        (["name.x=1"], "unknown option 'name.x': 'name' has no options of its own"),
        (["steps=many"], "option 'steps' takes a whole number, not 'many'"),
        (["steps=true"], "option 'steps' takes a whole number, not True"),
        (["steps=1.5"], "option 'steps' takes a whole number, not 1.5"),
        (["nested.rate=high"], "option 'nested.rate' takes a number, not 'high'"),
        (["flag=1"], "option 'flag' takes true or false, not 1"),
        (["sizes=3"], "option 'sizes' takes a list, not 3"),
        (["nested=3"], "'nested' is a section: set one of its options with nested.name=value"),
        (["preset=huge"], "unknown preset 'huge': choose one of paper, strong"),
        (["task=a,b"], "option 'task' got several values: add --multirun to run each"),
        (["+nested.rat=1"], "unknown option 'nested.rat' (did you mean 'rate'?)"),
        (["+nestd.rate=1"], "unknown option 'nestd.rate' (did you mean 'nested'?)"),
        (["+stepz=1"], "unknown option 'stepz' (did you mean 'steps'?)"),
        (["task"], "cannot read 'task': options are written name=value"),
        (["task=[a"], "cannot read 'task=[a': options are written name=value"),
        (["--tsk"], "unknown flag '--tsk': options are written name=value; see --help"),
        (["--cfg"], "argument --cfg/-c: expected one argument"),
        (["--config-name", "none"], "there are no options named 'none' in "),
        (["task=fly"], "unknown task 'fly': choose move or pick"),
        (["task=missing"], "option 'folder' is required: give it a value"),
        (["-m", "preset=paper,huge"], "unknown preset 'huge': choose one of paper, strong"),
        (["steps=1,2", "--multirun", "task=pick"], "'task=pick' stands after a flag: put"),
        (["-m", "steps=1,many"], "option 'steps' takes a whole number, not 'many'"),
        (["-m", "steps=range(0, 1, 0.5)"], "option 'steps' takes a whole number, not 0.0"),
        (["-m", "sizes=[3],4"], "option 'sizes' takes a list, not 4"),
    ],
)
def test_a_mistake_gets_one_line_and_code_2(recipes, capsys, arguments, said):
    assert run("run", "greet", *arguments) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.startswith(f"error: {said}")
    assert printed.err.count("\n") == 1
    assert list(Path.cwd().iterdir()) == []


@pytest.mark.parametrize(
    "argument",
    ["name=mine", "limit=5", "folder=here", "+limit=1", "~flag", "sizes=[3]", "nested.rate=2"],
)
def test_what_options_offer_is_accepted(recipes, capsys, argument):
    assert run("run", "greet", argument) == 0
    assert capsys.readouterr().out.startswith("hello move")


def test_several_values_run_one_after_the_other(recipes, capsys):
    assert run("run", "greet", "--multirun", "task=move,pick", "nested.rate=0.5") == 0
    assert capsys.readouterr().out == "hello move 0.5 64\nhello pick 0.5 64\n"
    assert run("run", "greet", "--multirun", "preset=glob(*)", "limit=range(2)") == 0
    assert capsys.readouterr().out.count("hello") == 4
    assert list(Path.cwd().iterdir()) == []


def test_an_interruption_is_no_mistake(recipes, capsys):
    assert run("run", "greet", "task=interrupt") == 130
    assert capsys.readouterr().err == "interrupted\n"


def test_a_bug_keeps_its_traceback(recipes):
    # In a process of its own: Hydra passes exceptions on where something traces it.
    command = [sys.executable, str(recipes / "greet.py"), "task=bug"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "Traceback" in done.stderr
    assert "RuntimeError: a bug" in done.stderr


def test_the_traceback_of_a_mistake_can_be_asked_for(recipes, monkeypatch):
    monkeypatch.setenv(FULL_ERROR, "1")
    with pytest.raises(UserError, match="unknown task"):
        cli.main(["run", "greet", "task=fly"])


def test_help_of_a_recipe_lists_its_options(recipes, capsys):
    assert run("run", "greet", "--help") == 0
    printed = capsys.readouterr().out
    assert printed.startswith("greet: options are written name=value")
    assert "\n  preset: paper, strong\n" in printed
    assert "\nname: move-run" in printed
    assert "\nlimit: null" in printed
    assert "\nsizes: [1, 2]" in printed
    assert re.search(r"\nnested:\n  rate: 0.5 +# how fast\n", printed + "\n")
    assert run("run", "greet", "task=pick", "--help") == 0
    assert "\nname: pick-run" in capsys.readouterr().out
    assert run("run", "greet", "tsk=pick", "--help") == 2


@pytest.mark.parametrize("chosen", [[], ["preset=paper", "budget=full"], ["world=babyai"]])
def test_help_says_what_every_option_means(capsys, chosen):
    for name in _folder.recipe_names():
        said = [] if name == "reproduce" else chosen
        assert run("run", name, *said, "--help") == 0
        printed = capsys.readouterr().out
        lines = printed.partition("mean:\n\n")[2].partition("\noptions_of:")[0].splitlines()
        for line, after in itertools.pairwise([*lines, ""]):
            assert len(line) <= 100 or "#" not in line
            assert "#" in line + after or line.endswith(":"), f"{name}: {line} has no meaning"


def test_help_ends_where_its_reader_does():
    script = recipes_folder() / "imitate.py"
    command = f"{sys.executable} {script} --help | head -1"
    done = subprocess.run(command, shell=True, capture_output=True, text=True, check=True)
    assert (done.stdout.count("\n"), done.stderr) == (1, "")


def test_a_recipe_runs_as_a_script_too(recipes):
    command = [sys.executable, str(recipes / "greet.py"), "task=pick"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout == "hello pick 0.5 64\n"
    done = subprocess.run([*command, "seed=1"], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["demoo"], "unknown command 'demoo' (did you mean 'demo'?): choose one of demo, "),
        (["run"], "which recipe? choose one of greet"),
        (["run", "great"], "unknown recipe 'great' (did you mean 'greet'?): choose one of greet"),
    ],
)
def test_an_unknown_command_or_recipe_is_named(recipes, capsys, monkeypatch, arguments, said):
    monkeypatch.setattr(cli, "recipe_names", lambda: ["greet"])
    assert run(*arguments) == 2
    printed = capsys.readouterr().err
    assert printed.startswith(f"error: {said}")
    assert printed.count("\n") == 1


def test_a_choice_that_a_recipe_has_not_is_named(capsys):
    assert run("run", "reproduce", "preset=strong") == 2
    printed = capsys.readouterr().err
    assert printed.startswith("error: reproduce has no option 'preset' (did you mean 'presets'?)")
    assert printed.count("\n") == 1


def test_help_and_version(capsys):
    assert run() == run("--help") == run("-h") == run("run", "--help") == 0
    printed = capsys.readouterr().out
    for command in [*cli.COMMANDS, "run"]:
        assert f"\n  {command} " in printed
    assert run("--version") == 0
    assert capsys.readouterr().out == f"ifo-grounding {version('ifo-grounding')}\n"


def test_every_command_has_its_recipe_and_every_recipe_its_options():
    names = _folder.recipe_names()
    assert {recipe for recipe, _ in cli.COMMANDS.values()} <= set(names)
    for name in names:
        check_options(recipes_folder() / "conf", name, [])
        first = (recipes_folder() / "conf" / f"{name}.yaml").read_text().splitlines()[0]
        assert f"recipes/{name}.py" in first, f"{name}.yaml begins with the command that runs it"


def test_an_installation_without_recipes_says_so(tmp_path, monkeypatch):
    monkeypatch.setattr(_folder, "__file__", str(tmp_path / "a" / "b" / "_folder.py"))
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


def test_jobs_of_a_sweep_do_not_overwrite_each_other(recipes, capsys):
    with (recipes / "conf" / "greet.yaml").open("a") as options:
        options.write("run: ${task}-${width}\n")
    assert run("run", "greet", "--multirun", "steps=1,2") == 2
    said = capsys.readouterr().err
    assert said.startswith("error: several jobs of this sweep are the run 'move-64': name them")
    assert run("run", "greet", "--multirun", "steps=1,2", "run='${task}-${steps}'") == 0
    assert run("run", "greet", "--multirun", "preset=paper,strong", "task=move,pick") == 0
    assert capsys.readouterr().out.count("hello") == 6
