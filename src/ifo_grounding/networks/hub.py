"""Where networks of others come from: those of the package, and the Hugging Face Hub."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ifo_grounding.errors import UserError, check_choice, first_line, optional

WEIGHTS = "network.safetensors"
CARD = "README.md"
FILES = [WEIGHTS, CARD]
OWN = "ifo-grounding"
"""Owner of the networks that come with the package: ``ifo-grounding/move`` and the other tasks."""
PRETRAINED = Path(__file__).parents[1] / "pretrained"


def own(source: str, kind: str) -> Path:
    """Return the folder of a network that comes with the package."""
    there = {f"{OWN}/{each.name}": each for each in sorted(PRETRAINED.iterdir())}
    check_choice("network", source, there)
    kinds = {each.name: each for each in sorted(there[source].iterdir())}
    check_choice(f"kind of {source}", kind, kinds)
    return kinds[kind]


def upload(folder: Path, hub_id: str, private: bool | None = None, **options: Any) -> None:
    """Send the files of a network in one commit."""
    hub = optional("huggingface_hub", extra="hub")
    api = hub.HfApi(token=options.pop("token", None))
    try:
        repo = api.create_repo(hub_id, private=private, exist_ok=True)
        api.upload_folder(repo_id=repo.repo_id, folder_path=folder, allow_patterns=FILES, **options)
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
