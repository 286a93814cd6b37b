"""The tabs of the page: which event asks what of a visit, and what it draws."""

from __future__ import annotations

from collections.abc import Callable
from html import escape
from typing import Any, NamedTuple

from ifo_grounding.errors import UserError, optional
from ifo_grounding.playground import drawing
from ifo_grounding.playground.agent import CHARACTERS
from ifo_grounding.playground.teaching import FORMS
from ifo_grounding.playground.visit import LOOK, TOOLS, Source, Visit
from ifo_grounding.texts import one_line

gradio: Any = optional("gradio", extra="play")
IN_TURN: Any = {
    **{"show_progress": "hidden", "trigger_mode": "multiple"},
    **{"concurrency_id": "visit", "concurrency_limit": 1},
}
"""How events are handled: one after another, so that what was asked for last is drawn last."""
EVERY = 2.0
"""Seconds between two looks at a training."""


def does(action: Callable[..., Any], draw: Callable[[Visit], Any]) -> Callable[..., Any]:
    """Return a handler that does something in a visit and draws it; what is wrong is said there."""

    def handle(visit: Visit, *values: Any) -> Any:
        with visit.turn:
            visit.wrong = ""
            try:
                action(visit, *values)
            except (UserError, OSError) as error:
                visit.wrong = one_line(error)
            return draw(visit)

    return handle


def wrong(visit: Visit) -> str:
    """Say what was wrong, nothing where nothing was."""
    return f'<p class="wrong" role="alert">{escape(visit.wrong)}</p>' if visit.wrong else ""


class Tab(NamedTuple):
    """One tab: its outputs, and what draws them."""

    draw: Callable[..., Any]
    shown: list[Any]
    show: Any = None
    """The button that shows what was trained."""


def watch_tab(source: Source, visit: Any) -> Tab:
    """Watch and talk."""
    with gradio.Row():
        name = gradio.Dropdown(list(source.names), label="Networks")
        scene = gradio.Number(0, label="Scene", precision=0, minimum=0)
        seed = gradio.Number(0, label="Seed", precision=0, minimum=0)
        another = gradio.Button("Next scene")
    sentence = gradio.Textbox(
        label="Say what to do", max_length=CHARACTERS, submit_btn="Tell", elem_id="sentence"
    )
    completions = gradio.Dataset(
        components=[sentence], samples=[], label="It could be told", elem_id="completions"
    )
    status = gradio.HTML(elem_id="status")
    with gradio.Row():
        back, play, forth = (gradio.Button(word, min_width=60) for word in ("Back", "Play", "Step"))
        at = gradio.Slider(0, 1, 0, step=1, label="Step", scale=2)
        speed = gradio.Slider(0.5, 8, 2, step=0.5, label="Steps a second")
        looks = gradio.Checkbox(False, label="Where it looks")
    boards = gradio.HTML(js_on_load=drawing.EVENTS, elem_id="boards")
    arranging = "Arrange the scene: choose a thing, then click on a cell"
    with gradio.Accordion(arranging, open=False) as arrange:
        tool = gradio.Radio(list(TOOLS), value=LOOK, label="Put", elem_id="tool")
        undo = gradio.Button("As it was")
    timer = gradio.Timer(0.5, active=False)

    def step_drawn(visit: Visit) -> list[Any]:
        return [gradio.Slider(maximum=visit.steps, value=visit.at), visit.boards()]

    def heard(visit: Visit, said: str) -> list[Any]:
        """Say what is thought of a sentence while it is typed."""
        typed = said.strip()
        offered = visit.agent.complete(typed, visit.frame)
        told = typed == visit.sentence  # where what was typed is heard after it was told
        unfinished = offered and not told and typed not in visit.agent.sentences
        thought = "<p>Go on, or choose.</p>" if unfinished else _suits(visit, typed)
        return [gradio.Dataset(samples=[[each] for each in offered]), thought]

    def draw(visit: Visit) -> list[Any]:
        said = visit.said if visit.sentence is None else visit.sentence
        offered = gradio.Dataset(samples=[[each] for each in visit.agent.complete("", visit.frame)])
        return [
            gradio.Dropdown(choices=visit.names, value=visit.name),
            visit.scene,
            visit.seed,
            gradio.skip() if visit.wrong else said,
            offered,
            wrong(visit) or _suits(visit, said),
            *step_drawn(visit),
            gradio.Accordion(visible=visit.agent.arranges),
            gradio.Button("Play"),
            gradio.Timer(active=False),
        ]

    shown = [name, scene, seed, sentence, completions, status, at, boards, arrange, play, timer]
    moved = [at, boards]

    def on(event: Any, action: Callable[..., Any], *given: Any) -> None:
        event(does(action, draw), [visit, *given], shown, **IN_TURN)

    on(name.input, Visit.choose, name)
    on(scene.submit, Visit.go, scene, seed)
    on(seed.submit, Visit.go, scene, seed)
    on(another.click, lambda visit: visit.go(visit.scene + 1, visit.seed))
    on(undo.click, lambda visit: visit.go(visit.scene, visit.seed))
    on(sentence.submit, Visit.tell, sentence)
    sentence.input(
        heard,
        [visit, sentence],
        [completions, status],
        **{**IN_TURN, "trigger_mode": "always_last"},
    )
    completions.click(lambda row: row[0], completions, sentence, **IN_TURN).then(
        does(Visit.tell, draw), [visit, sentence], shown, **IN_TURN
    )

    def clicked(visit: Visit, event: gradio.EventData) -> list[Any]:
        return does(Visit.click, draw)(visit, int(event.cell))

    boards.click(clicked, visit, shown, **IN_TURN)
    tool.input(does(Visit.hold, step_drawn), [visit, tool], moved, **IN_TURN)

    def at_step(visit: Visit, value: float) -> None:
        visit.step(int(value) - visit.at)

    def to_look(visit: Visit, value: bool) -> None:
        visit.looks = bool(value)

    at.release(does(at_step, step_drawn), [visit, at], moved, queue=False, **IN_TURN)
    looks.input(does(to_look, step_drawn), [visit, looks], moved, queue=False, **IN_TURN)
    for button, by in ((back, -1), (forth, 1)):
        move = does(lambda visit, by=by: visit.step(by), step_drawn)
        button.click(move, visit, moved, queue=False, **IN_TURN)

    def ticked(visit: Visit) -> list[Any]:
        visit.step(1)
        ended = visit.at >= visit.steps
        return [*step_drawn(visit), "Play" if ended else "Pause", gradio.Timer(active=not ended)]

    def toggled(visit: Visit, label: str, speed: float) -> list[Any]:
        if label == "Pause":
            return [*step_drawn(visit), "Play", gradio.Timer(active=False)]
        visit.at = 0 if visit.at >= visit.steps else visit.at
        return [*step_drawn(visit), "Pause", gradio.Timer(1 / speed, active=True)]

    running = [*moved, play, timer]
    timer.tick(ticked, visit, running, queue=False, **IN_TURN)
    play.click(toggled, [visit, play, speed], running, **IN_TURN)
    speed.release(lambda speed: gradio.Timer(1 / speed), speed, timer, **IN_TURN)
    return Tab(draw, shown)


def _suits(visit: Visit, sentence: str) -> str:
    """Say what the instruction classifier and the oracle think of a sentence in this scene."""
    if not sentence:
        return "<p>Say something, or choose what it could be told here.</p>"
    try:
        found = visit.suited(sentence)
    except UserError as error:
        return f'<p class="wrong">{escape(one_line(error))}</p>'
    said = []
    if found.probability is not None:
        said.append(f"Suits, says the instruction classifier: <b>{found.probability:.0%}</b>")
    if visit.agent.world.oracle is not None:
        known = "it is no sentence of this task, so that nobody can judge it"
        said.append(f"In truth: {escape(found.truth or known)}")
    return f"<p>{' · '.join(said) or 'Nobody knows whether it suits.'}</p>"


def teach_tab(visit: Any) -> Tab:
    """Teach by showing."""
    gradio.Markdown(
        "Say what you will show, then show it with the buttons or the keys, and stop. What is kept "
        "are the pictures and your sentence, never what you pressed. Invent a task that nobody "
        "has named: two sentences or more, some ten demonstrations of each."
    )
    sentence = gradio.Textbox(label="What you show", max_length=CHARACTERS, elem_id="shown")
    status = gradio.HTML(elem_id="taught")
    with gradio.Row():
        board = gradio.HTML(js_on_load=drawing.EVENTS, elem_id="pad")
        with gradio.Column():
            listed = gradio.HTML(js_on_load=drawing.EVENTS, elem_id="lessons")
            film = gradio.HTML()
            drop = gradio.Button("Throw away the chosen one")
    with gradio.Row():
        again = gradio.Button("Another scene")
        done = gradio.Button("Done: it ends here")
    with gradio.Row():
        form = gradio.Dropdown(list(FORMS), label="Save as")
        save = gradio.Button("Save")
        file = gradio.File(label="Saved", interactive=False, height=90)
    with gradio.Row():
        train = gradio.Button("Train both phases", variant="primary")
        show = gradio.Button("Watch what was trained", elem_id="watch")
    progress = gradio.HTML(elem_id="progress")
    timer = gradio.Timer(EVERY, active=False)
    chosen = gradio.State(None)

    def draw(visit: Visit, row: int | None = None) -> list[Any]:
        lesson = visit.lesson
        rows = [
            (number, (number + 1, one.sentence, len(one.frames) - 1))
            for number, one in enumerate(lesson.episodes)
        ]
        kept = lesson.episodes[row : row + 1] if row is not None else []
        return [
            drawing.pad(lesson.picture(), lesson.steps, lesson.world.actions),
            wrong(visit),
            drawing.table(rows, ("number", "sentence", "steps"), row) if rows else "",
            drawing.strip(list(kept[0].pictures)) if kept else "",
            row if kept else None,
            gradio.Button(visible=lesson.world.stop_action is None),
            *trained(visit),
        ]

    def trained(visit: Visit) -> list[Any]:
        training = visit.study.training
        if training is None:
            return ["", gradio.Timer(active=False)]
        ended = training.ended
        now = "trained: watch it" if training.done == 1 else training.now
        said = (
            f'<p><progress max="1" value="{training.done:.2f}"></progress> {escape(now)}</p>'
            f"<p>It goes on where you close this page; then type <code>{escape(training.command)}"
            "</code>, which goes on where it was.</p>"
        )
        return [said, gradio.Timer(active=not ended)]

    shown = [board, status, listed, film, chosen, done, progress, timer]

    def pressed(visit: Visit, said: str, event: gradio.EventData) -> list[Any]:
        return does(lambda visit: visit.lesson.act(int(event.act), said), draw)(visit)

    def looked(visit: Visit, event: gradio.EventData) -> list[Any]:
        return draw(visit, int(event.row))

    def dropped(visit: Visit, row: int | None) -> None:
        if row is None:
            raise UserError("choose a demonstration first: click on its row")
        visit.lesson.drop(row)

    def saved(visit: Visit) -> list[Any]:
        if visit.wrong or visit.saved is None:
            return [None, wrong(visit)]
        folder, file = visit.saved
        return [str(file), f"<p>Written: {escape(str(folder))}</p>"]

    def finished(visit: Visit, said: str) -> None:
        visit.lesson.finish(said)

    board.click(pressed, [visit, sentence], shown, **IN_TURN)
    listed.click(looked, visit, shown, **IN_TURN)
    drop.click(does(dropped, draw), [visit, chosen], shown, **IN_TURN)
    again.click(does(lambda visit: visit.lesson.begin(), draw), visit, shown, **IN_TURN)
    done.click(does(finished, draw), [visit, sentence], shown, **IN_TURN)
    save.click(does(Visit.archive, saved), [visit, form], [file, status], **IN_TURN)
    train.click(does(Visit.train, draw), visit, shown, **IN_TURN)
    timer.tick(trained, visit, [progress, timer], **IN_TURN)
    return Tab(draw, shown, show)


def look_tab(visit: Any) -> None:
    """Look at recordings."""
    folder = gradio.Textbox(
        label="Folder of demonstrations: saved ones, pictures, or LeRobot's",
        submit_btn="Look",
        elem_id="folder",
    )
    status = gradio.HTML(elem_id="looked")
    film = gradio.HTML(elem_id="film")
    listed = gradio.HTML(js_on_load=drawing.EVENTS, elem_id="recorded")

    def draw(visit: Visit) -> list[Any]:
        count = "" if visit.recording is None else f"<p>{len(visit.recording):,} demonstrations, "
        count += "those first that look wrong. Click on a row.</p>" if count else ""
        return [wrong(visit) or count, visit.film(), visit.listed() if visit.rows else ""]

    def chosen(visit: Visit, event: gradio.EventData) -> list[Any]:
        visit.wrong, visit.row = "", min(int(event.row), len(visit.rows) - 1)
        return draw(visit)

    shown = [status, film, listed]
    folder.submit(does(Visit.open, draw), [visit, folder], shown)
    listed.click(chosen, visit, shown, **IN_TURN)
