"""Networks on disk: a file of weights and words, or a folder for others with a model card."""

from __future__ import annotations

import json
import zlib
from collections.abc import Callable, Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import nn

from ifo_grounding.errors import UserError, first_line
from ifo_grounding.files import atomic_write, regular_file, unwritable
from ifo_grounding.machine import check_device
from ifo_grounding.networks import makers
from ifo_grounding.networks.card import LIBRARY, card
from ifo_grounding.networks.hub import CARD, OWN, WEIGHTS, downloaded, own, upload
from ifo_grounding.networks.makers import Blueprint
from ifo_grounding.networks.shapes import Shapes
from ifo_grounding.tasks.vocabulary import Vocabulary

FORMAT = "ifo-grounding network 2"
MAKERS: dict[str, Callable[..., Any]] = {
    "inverse": makers.make_inverse,
    "policy": makers.make_policy,
    "value": makers.make_value,
    "instruction": makers.make_instruction_classifier,
    "reward": makers.make_reward_model,
    "goal": makers.make_goal_classifier,
}
GONE = ("precision",)
"""Options that older files name, and that decide nothing."""
MOST_BUFFERS = 1 << 28  # bytes that depend on the size of images, and on no weight


def save(module: nn.Module, path: str | Path) -> str:
    """Write a network built by a ``make_*`` function to ``path``, atomically, with its words.

    Its words are its attribute ``vocabulary``, which ``make_*`` reads from what it is built for.
    What was copied from ``init_from`` is not kept: training on after loading lets weights decay to
    zero, not to what they were there.

    Returns a checksum, by which :func:`load` tells this network from others.

    Raises:
        UserError: for any other module, for words that do not fit it, or where the disk is full.

    >>> import tempfile
    >>> policy = makers.make_policy(Shapes(image_shape=(3, 16, 16), vocabulary_size=9), seed=0)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     checksum = save(policy, f"{folder}/policy.safetensors")
    ...     again = load(f"{folder}/policy.safetensors", checksum=checksum)
    >>> all(map(torch.equal, policy.state_dict().values(), again.state_dict().values()))
    True
    """
    path, plan = Path(path), asdict(_blueprint(module))
    words: Any = module.vocabulary
    plan["vocabulary"] = None if words is None else asdict(words)
    texts = {"format": FORMAT, "network": json.dumps(plan, sort_keys=True)}
    state = module.state_dict().items()
    weights = {name: value.detach().cpu().contiguous() for name, value in state}
    checksum = _checksum(texts, weights)
    try:
        with atomic_write(path) as temporary:
            save_file(weights, temporary, {**texts, "checksum": checksum})
    except (OSError, SafetensorError) as error:
        raise unwritable(path, first_line(error)) from error
    return checksum


def load(
    path: str | Path,
    device: torch.device | str | None = None,
    kind: str | None = None,
    checksum: str | None = None,
) -> Any:
    """Read a network that :func:`save` wrote and build it again, with its words, on ``device``.

    Args:
        kind: the kind that is expected (``"policy"``, ``"inverse"``, ...); None allows any.
        checksum: what :func:`save` returned for it; None allows any.

    Raises:
        UserError: where the file is missing, damaged, of another origin or another kind.
    """
    check_device(device or "cpu")
    plan, weights = _read(Path(path), checksum)
    found = str(plan.get("kind"))
    if kind not in (None, found):
        raise UserError(f"{path} holds a network of kind {found!r}, not {kind!r}")
    try:
        options = {name: _key(value) for name, value in plan["options"].items()}
        options["in_keys"] = [_key(value) for value in plan["options"]["in_keys"]]
        config = {name: value for name, value in plan["config"].items() if name not in GONE}
        make = partial(MAKERS[found], Shapes(**plan["shapes"]), **options, **config)
        with torch.device("meta"):  # takes no memory for sizes that a file only claims
            claimed = make(device="meta")
        claimed.load_state_dict(weights, assign=True)
        if sum(buffer.nbytes for buffer in claimed.buffers()) > MOST_BUFFERS:
            raise ValueError(f"images of {plan['shapes']['image_shape']} are too large")
        module = make(device=device, seed=0)
        module.load_state_dict(weights)
        if (words := plan.get("vocabulary")) is not None:
            module.vocabulary = Vocabulary(**words)
            _blueprint(module)
    except torch.OutOfMemoryError:
        raise  # says nothing against the file
    except (LookupError, TypeError, AttributeError, RuntimeError, ValueError) as error:
        raise UserError(
            f"{path} does not fit this version of ifo-grounding ({first_line(error)}): train the "
            "network again"
        ) from None
    return module


def save_pretrained(
    module: nn.Module,
    folder: str | Path,
    *,
    facts: Mapping[str, object] | None = None,
    hub_id: str | None = None,
    **hub: Any,
) -> Path:
    """Write a network as a folder with a model card, and send it to the Hugging Face Hub if asked.

    Args:
        folder: where to. In a folder that exists, the card and ``network.safetensors`` are
            replaced, never what symbolic links of these names point to. Everything else stays, and
            so does a ``README.md`` that is no card of this library.
        facts: what the card says, such as ``{"Task": "move", "Success": "99.7% [99.5, 99.8]"}``.
        hub_id: ``user/name`` on the Hub; needs the extra ``hub`` and an account that is logged in.
        hub: ``private``, ``token``, and options of ``huggingface_hub.HfApi.upload_folder`` such as
            ``commit_message``, ``revision`` or ``create_pr``.

    Raises:
        UserError: as of :func:`save`, for a ``folder`` that is none, a missing extra, or where the
            Hub refuses.
    """
    folder, plan = Path(folder), _blueprint(module)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(
            f"{folder} is no folder and cannot be made one ({error.strerror}): choose another"
        ) from None
    page, weights = folder / CARD, folder / WEIGHTS
    for path in (page, weights):
        if path.is_symlink():
            path.unlink()
    if not page.is_file() or LIBRARY in page.read_text(encoding="utf-8", errors="replace"):
        with atomic_write(page) as temporary:
            temporary.write_text(card(plan, facts or {}), encoding="utf-8", errors="replace")
    save(module, weights)
    if hub_id is not None:
        upload(folder, hub_id, **hub)
    return folder


def from_pretrained(
    source: str | Path,
    device: torch.device | str | None = None,
    kind: str | None = None,
    **hub: Any,
) -> Any:
    """Load a network that :func:`save_pretrained` wrote, with its words.

    Args:
        source: its folder, ``user/name`` on the Hugging Face Hub (extra ``hub``), or
            ``ifo-grounding/TASK`` of those that come with the package: for each task a ``policy``,
            an ``instruction`` and a ``goal`` classifier.
        kind: the kind that is expected, such as ``"policy"``; None allows any, and takes the policy
            of a task.
        hub: for ``huggingface_hub.snapshot_download``, such as ``revision``, ``cache_dir``,
            ``token`` or ``local_files_only``.

    Raises:
        UserError: where there is no such folder, here or on the Hub, or it holds no network of
            that kind.

    >>> policy = from_pretrained("ifo-grounding/move")
    >>> policy.vocabulary.decode(policy.vocabulary.encode(["move to the red circle"]))
    ['move to the red circle']
    """
    folder = Path(source)
    if str(source).startswith(f"{OWN}/") and not folder.exists():
        folder = own(str(source), kind or "policy")
    if not folder.is_dir():
        if folder.exists() or str(source).count("/") != 1 or str(source)[0] in "./~":
            raise UserError(
                f"{source} is no folder that save_pretrained wrote; on the Hub a network is called "
                "user/name"
            )
        folder = downloaded(str(source), hub)
    return load(folder / WEIGHTS, device=device, kind=kind)


def _blueprint(module: Any) -> Blueprint:
    """Return what a network was built by, or refuse other modules, and words that do not fit."""
    plan = getattr(module, "network_config", None)
    if not isinstance(plan, Blueprint):
        raise UserError(
            f"cannot save {type(module).__name__}: only what a make_* function of "
            "ifo_grounding.networks built can be saved"
        )
    words, shapes = module.vocabulary, plan.shapes
    if words is not None and not shapes.fit(words):
        raise UserError(
            f"the vocabulary has {len(words)} token ids and {words.length} per instruction, but "
            f"the network was built for {shapes.vocabulary_size} and {shapes.instruction_length}: "
            "set the vocabulary that it was built for"
        )
    return plan


def _read(path: Path, checksum: str | None) -> tuple[dict[str, Any], dict[str, torch.Tensor]]:
    """Return the blueprint and the words of a file, as JSON has them, and the weights."""
    try:
        with safe_open(regular_file(path) if path.exists() else path, framework="pt") as file:
            texts = dict(file.metadata() or {})
            if texts.get("format") != FORMAT:
                raise UserError(
                    f"{path} is no network of this version of ifo-grounding (format "
                    f"{texts.get('format')!r}, expected {FORMAT!r}): train it again"
                )
            weights = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
        known = {texts.pop("checksum", None), checksum, None}
        if not known <= {_checksum(texts, weights), None}:
            raise ValueError("by its checksum, it is not what was saved")
        if not all(weight.isfinite().all() for weight in weights.values()):
            raise ValueError("weights are not finite")
        return dict(json.loads(texts["network"])), weights
    except FileNotFoundError:
        raise UserError(f"{path} does not exist") from None
    except UserError:
        raise
    except (SafetensorError, OSError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise UserError(
            f"{path} is damaged, another network or no safetensors file ({error}): restore it, or "
            "delete it and train again"
        ) from None


def _checksum(texts: Mapping[str, str], weights: Mapping[str, torch.Tensor]) -> str:
    """Return a checksum of all that a file of a network holds."""
    found = zlib.crc32(json.dumps(texts, sort_keys=True).encode())
    for name, weight in sorted(weights.items()):
        found = zlib.crc32(f"{name} {weight.dtype} {list(weight.shape)}".encode(), found)
        found = zlib.crc32(weight.reshape(-1).view(torch.uint8).numpy().data, found)
    return f"{found:08x}"


def _key(value: Any) -> Any:
    """Turn a nested key, of which JSON made a list, into a tuple again."""
    return tuple(value) if isinstance(value, list) else value
