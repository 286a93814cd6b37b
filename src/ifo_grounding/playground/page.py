"""The page itself, on Gradio."""

from __future__ import annotations

import secrets
import socket
from typing import Any

from ifo_grounding.errors import UserError, optional
from ifo_grounding.playground import drawing
from ifo_grounding.playground.tabs import does, look_tab, teach_tab, watch_tab
from ifo_grounding.playground.visit import Source, Study, Visit

gradio: Any = optional("gradio", extra="play")
LOCAL = "127.0.0.1"
MOST_STUDIES = 256
"""People whose lessons are kept in memory."""


def open_page(source: Source, host: str = LOCAL, port: int = 7860, browser: bool = True) -> None:
    """Serve the page until it is interrupted.

    Args:
        source: where agents come from.
        host: address to listen on; others than this machine's own let others in.
        port: to listen on.
        browser: whether to open it in a browser.

    Raises:
        UserError: where the port is taken, the address is none of this machine's, or the networks
            cannot be loaded.
    """
    source.load(source.names[0])  # what is wrong with it is said before a page opens
    page = build_page(source)
    with socket.socket() as trial:
        trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            trial.bind((host, port))
        except OSError as error:
            reason = error.strerror or error
            raise UserError(f"host={host} port={port}: {reason}; give another port=") from None
    how = {"theme": theme(), "css": drawing.STYLE, "footer_links": ["settings"], "ssr_mode": False}
    on = {"server_name": host, "server_port": port, "inbrowser": browser}
    page.launch(quiet=True, prevent_thread_lock=True, **on, **how)
    print(f"http://{host}:{port} until you press Ctrl-C", flush=True)
    if host != LOCAL:
        print(
            "anyone who reaches this machine can talk to the agent, train on its processors and "
            "fill its home folder; host=127.0.0.1 keeps it to yourself",
            flush=True,
        )
    page.block_thread()


def theme() -> Any:
    """Return the theme, with the fonts of the reader's own machine."""
    return gradio.themes.Default(
        font=["system-ui", "sans-serif"], font_mono=["ui-monospace", "monospace"]
    )


def recalled(studies: dict[str, Study], known: str) -> Study:
    """Return what a person showed before; who came longest ago is forgotten."""
    study = studies.pop(known) if known in studies else Study()
    studies[known] = study
    if len(studies) > MOST_STUDIES:
        del studies[next(iter(studies))]
    return study


def build_page(source: Source) -> Any:
    """Return the page as ``gradio.Blocks``, which also runs in a notebook or in a Space."""
    studies: dict[str, Study] = {}
    with gradio.Blocks(title="ifo-grounding", analytics_enabled=False) as page:
        token = gradio.BrowserState("", storage_key="ifo-grounding")
        visit = gradio.State(None)

        def begin(known: str) -> tuple[str, Visit]:
            """Return a fresh tab of a browser, which finds what it taught before."""
            known = known if known in studies else secrets.token_urlsafe()
            return known, Visit(source, recalled(studies, known))

        entered = page.load(begin, token, [token, visit], show_progress="hidden")
        with gradio.Tab("Watch and talk"):
            watch = watch_tab(source, visit)
        with gradio.Tab("Teach by showing"):
            teach = teach_tab(visit)
        with gradio.Tab("Look at recordings"):
            look_tab(visit)
        entered.then(watch.draw, visit, watch.shown, show_progress="hidden")
        entered.then(teach.draw, visit, teach.shown, show_progress="hidden")
        # What was taught is watched where agents are.
        teach.show.click(does(Visit.show, watch.draw), visit, watch.shown, show_progress="hidden")
    return page
