"""Where networks of others come from: those of the package, and the Hugging Face Hub."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ifo_grounding.errors import UserError, first_line, optional

WEIGHTS = "network.safetensors"
WORDS = "vocabulary.json"
"""Words of a folder whose network does not hold them itself."""
CARD = "README.md"
FILES = [WEIGHTS, WORDS, CARD]
OWN = "ifo-grounding"
"""Owner of the networks that come with the package: ``ifo-grounding/move`` and the other tasks."""
PRETRAINED = Path(__file__).parents[1] / "pretrained"


def own(source: str, kind: str) -> Path:
    """Return the folder of a network that comes with the package."""
    there = {f"{OWN}/{each.parent.name}" for each in PRETRAINED.glob("*/policy")}
    if source not in there:
        raise UserError(f"unknown network {source!r}: choose one of {', '.join(sorted(there))}")
    folder = PRETRAINED / source.partition("/")[2] / kind
    if not folder.is_dir():
        kinds = ", ".join(sorted(each.name for each in folder.parent.iterdir()))
        raise UserError(f"{source} has no network of kind {kind!r}: choose one of {kinds}")
    return folder


def upload(folder: Path, hub_id: str, private: bool | None = None, **options: Any) -> None:
    """Send the files of a network in one commit; those of another that was there go with it."""
    hub = optional("huggingface_hub", extra="hub")
    api = hub.HfApi(token=options.pop("token", None))
    try:
        repo = api.create_repo(hub_id, private=private, exist_ok=True)
        api.upload_folder(
            repo_id=repo.repo_id,
            folder_path=folder,
            allow_patterns=FILES,
            delete_patterns=[WORDS],
            **options,
        )
    except TypeError:  # an option that there is not
        raise
    except Exception as error:  # the client's and those of its transport, which share no base
        raise UserError(
            f"{hub_id} could not be sent to the Hugging Face Hub ({first_line(error)}): mend the "
            "name or the connection, or log in with `hf auth login`"
        ) from None


def downloaded(hub_id: str, options: dict[str, Any]) -> Path:
    """Return the folder to which a network of the Hub was downloaded."""
    hub = optional("huggingface_hub", extra="hub")
    try:
        return Path(hub.snapshot_download(hub_id, allow_patterns=FILES, **options))
    except (OSError, ValueError) as error:  # what all errors of the Hub are
        raise UserError(
            f"{hub_id} is neither a folder nor a repository of the Hugging Face Hub that can be "
            f"reached ({first_line(error)}): mend the name, or the connection"
        ) from None
