"""A GPU where there is none: tensors in main memory that say ``cuda:0`` and refuse to meet others.

What runs here has the devices of its tensors right, and takes the paths that a GPU takes. Nothing
is said of CUDA's own kernels and graphs, of its random numbers or of its speed.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator
from typing import Any, ClassVar

import pytest
import torch
from torch.overrides import TorchFunctionMode
from torch.utils._pytree import tree_map_only

from ifo_grounding.training import updates

GPU = torch.device("cuda", 0)
ACROSS = {"copy_", "__set__"}
"""What may read from another device than it writes to."""
INDEXING = {"__getitem__", "__setitem__"}


class OnGPU(torch.Tensor):
    """A tensor that says that it lies on a GPU."""

    device = property(lambda self: GPU)
    is_cuda = property(lambda self: True)
    is_cpu = property(lambda self: False)


class Generator(torch.Generator):
    """Random numbers of a device, pretended or not."""

    def __new__(cls, device: torch.device | str = "cpu") -> Generator:
        made = super().__new__(cls)
        made.place = torch.device(device)
        return made

    device = property(lambda self: self.place)


@contextlib.contextmanager
def pretended_gpu() -> Iterator[None]:
    """Let ``device="cuda"`` be such a device, for as long as this lasts, or the real one."""
    if torch.cuda.is_available():
        yield
        return
    with pytest.MonkeyPatch.context() as patch, _Mode():
        patch.setattr(torch, "Generator", Generator)
        patch.setattr(updates, "CapturedUpdate", _Graph)
        patch.setattr(updates, "let_capture", lambda optimizer, captured: None)
        patch.setattr(torch, "save", _saving(torch.save))
        patch.setattr(torch.nn.Module, "_apply", _swapping(torch.nn.Module._apply))
        fork = torch.random.fork_rng
        patch.setattr(torch.random, "fork_rng", lambda devices=(), **rest: fork((), **rest))
        for name, value in {
            "is_available": True,
            "device_count": 1,
            "current_device": 0,
            "get_device_name": "a pretended GPU",
            "synchronize": None,
            "is_bf16_supported": False,
            "manual_seed_all": None,
            "is_current_stream_capturing": False,
        }.items():
            patch.setattr(torch.cuda, name, lambda *_, value=value, **__: value)
        yield


class _Graph:
    """An update of which only batches like the first one can be made."""

    def __init__(self, update: Callable) -> None:
        self.update, self.first = update, None

    def __call__(self, batch: Any) -> Any:
        shapes = {key: each.shape for key, each in batch.items(True, True)}
        self.first = self.first or shapes
        assert shapes == self.first, "a CUDA graph takes batches of the same shapes"
        return self.update(batch)


class _Mode(TorchFunctionMode):
    """Let whatever is computed from tensors on the GPU, or asked for there, lie there."""

    def __torch_function__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None):
        kwargs = dict(kwargs or {})
        if foreign := [each for each in types if not issubclass(each, torch.Tensor)]:
            with self:  # such as a tensor class, which calls what it is made of
                return foreign[0].__torch_function__(function, types, args, kwargs)
        name = getattr(function, "__name__", "")
        if special := self.special.get(name):
            return special(self, function, args, kwargs)
        inputs = list(_tensors((*args, *kwargs.values())))
        here = any(map(_on_gpu, inputs))
        if here:
            _check_inputs(name, inputs)
        if "device" in kwargs:
            here = _is_gpu(kwargs["device"]) if kwargs["device"] is not None else here
            kwargs["device"] = "cpu" if here else kwargs["device"]
        generator = kwargs.get("generator")
        if generator is not None and (generator.device.type == "cuda") != here:
            raise RuntimeError(f"{name} expects a generator of its own device")
        with torch._C.DisableTorchFunctionSubclass():
            result = function(*args, **kwargs)
        if isinstance(result, torch.Tensor):
            return _put(result) if here and name != "copy_" else result
        return tree_map_only(torch.Tensor, _put, result) if here else result

    def get(self, function: Any, args: Any, kwargs: Any) -> Any:
        with torch._C.DisableTorchFunctionSubclass():
            result = function(*args, **kwargs)
        return _put(result) if isinstance(result, torch.Tensor) and _on_gpu(args[0]) else result

    def to(self, function: Any, args: Any, kwargs: Any) -> Any:
        before, *others = args
        there = _on_gpu(before)
        for place, value in [*enumerate(others), *kwargs.items()]:
            if isinstance(value, torch.Tensor):
                there, value = _on_gpu(value), _taken(value)
            elif isinstance(value, (str, torch.device)) and torch.device(value).type != "meta":
                there, value = _is_gpu(value), "cpu"
            (others if isinstance(place, int) else kwargs)[place] = value
        with torch._C.DisableTorchFunctionSubclass():
            after = function(before, *others, **kwargs)
            if after is before and there != _on_gpu(before):
                after = after.clone()
        return _put(after) if there else _taken(after)

    def cpu(self, function: Any, args: Any, kwargs: Any) -> Any:
        return self.to(torch.Tensor.to, (args[0], "cpu"), kwargs)

    def parse_to(self, function: Any, args: Any, kwargs: Any) -> Any:
        return function(*args, **kwargs)

    def has_compatible_shallow_copy_type(self, function: Any, args: Any, kwargs: Any) -> bool:
        return _on_gpu(args[0]) == _on_gpu(args[1])

    def numpy(self, function: Any, args: Any, kwargs: Any) -> Any:
        if _on_gpu(args[0]):
            raise TypeError("a tensor on a GPU cannot be read by NumPy: copy it with cpu() first")
        return function(*args, **kwargs)

    def deepcopy(self, function: Any, args: Any, kwargs: Any) -> Any:
        value, memo = args
        if not _on_gpu(value):
            return function(*args, **kwargs)
        if id(value) not in memo:
            copied = _put(_taken(value).detach().clone()).requires_grad_(value.requires_grad)
            if isinstance(value, torch.nn.Parameter):
                copied = torch.nn.Parameter(copied, value.requires_grad)
            memo[id(value)] = copied
        return memo[id(value)]

    special: ClassVar = {
        "__get__": get,
        "to": to,
        "cpu": cpu,
        "_parse_to": parse_to,
        "_has_compatible_shallow_copy_type": has_compatible_shallow_copy_type,
        "numpy": numpy,
        "__array__": numpy,
        "__deepcopy__": deepcopy,
    }
    """Functions, by name, of which more is to be said than where their result lies."""


def _tensors(values: Iterable[Any]) -> Iterator[torch.Tensor]:
    for value in values:
        if isinstance(value, torch.Tensor):
            yield value
        elif isinstance(value, (tuple, list)):
            yield from _tensors(value)


def _check_inputs(name: str, inputs: list[torch.Tensor]) -> None:
    """Refuse what CUDA refuses: tensors on two devices, unless one of them is a mere number."""
    if name in ACROSS:
        return
    if name in INDEXING and _on_gpu(inputs[0]):  # by indices that may lie anywhere
        return
    sized = [each for each in inputs if each.dim()]
    if not all(map(_on_gpu, sized)):
        where = ", ".join(f"{list(each.shape)} on {each.device}" for each in inputs)
        raise RuntimeError(f"{name} expects all tensors on the same device, got {where}")


def _is_gpu(device: Any) -> bool:
    return torch.device(device).type == "cuda"


def _on_gpu(tensor: torch.Tensor) -> bool:
    return isinstance(tensor, OnGPU)


def _put(tensor: torch.Tensor) -> torch.Tensor:
    with torch._C.DisableTorchFunction():
        return tensor if _on_gpu(tensor) else tensor.as_subclass(OnGPU)


def _taken(tensor: torch.Tensor) -> torch.Tensor:
    with torch._C.DisableTorchFunction():
        return tensor.as_subclass(torch.Tensor) if _on_gpu(tensor) else tensor


def _swapping(apply: Callable) -> Callable:
    """Exchange a module's parameters as they move, for a tensor cannot change its class."""

    def swapped(module: torch.nn.Module, *args: Any, **kwargs: Any) -> torch.nn.Module:
        torch.__future__.set_swap_module_params_on_conversion(True)
        try:
            return apply(module, *args, **kwargs)
        finally:
            torch.__future__.set_swap_module_params_on_conversion(False)

    return swapped


def _saving(save: Callable) -> Callable:
    """Write plain tensors, as all that is loaded comes to the CPU first."""

    def saved(content: Any, *args: Any, **kwargs: Any) -> None:
        plain = tree_map_only(torch.Tensor, lambda tensor: _taken(tensor.detach()), content)
        save(plain, *args, **kwargs)

    return saved
