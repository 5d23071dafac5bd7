"""A CUDA device that is not there: tensors that say ``cuda:0``, compute on the CPU, and refuse what CUDA refuses.

    with simulated_cuda() as log:
        picture = torchpt.render(torchpt.load("cornell_box", device="cuda"), spp=2)
        print(log)                # operators, and the lines of the package that waited for the device

A :class:`SimulatedTensor` wraps a CPU tensor. Every operator with such an argument comes to :func:`_run`, which refuses what
CUDA refuses: operators that mix tensors of the device with tensors of the host (0-dim tensors and indices aside), custom
operators without a CUDA kernel, ``.numpy()`` and addresses of device tensors. It counts the times that the host would wait for
a real device: when numbers are copied from it or to it, and in operators whose result has a size that the device finds
(``nonzero``, ``unique``, masks as indices).

To C++ the wrappers are CPU tensors. Zeros that its autograd makes (for absent gradients, in formulas of derivatives) are
therefore host tensors, which on a real device they are not. They are told from the package's tensors by their memory: tensors
of the package are arguments of the call that Python made, zeros of C++ are not (:func:`_made_by_autograd`).

With ``rounds=True`` operators round differently from the CPU's where CUDA's kernels may: sums, products of matrices,
elementary functions, fused products, division by a number of the host.

Not simulated: speed, streams, memory, ``torch.compile``.
"""

from __future__ import annotations

import collections
import contextlib
import functools
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch.utils._pytree import tree_iter, tree_map

__all__ = ["Log", "SimulatedTensor", "simulated_cuda", "without_compiled_functions"]

_PACKAGE = str(Path(__file__).parents[2] / "torchpt")
#: Operators that take indices from the host, as in CUDA.
_INDEXING = frozenset({"index", "index_put", "index_put_", "_index_put_impl_", "_unsafe_index", "_unsafe_index_put"})
#: Operators that copy between devices.
_COPIES = frozenset({"copy_", "_to_copy"})
#: Operators that refuse 0-dim tensors of the host too, as they do not compute element by element.
_STRICT = frozenset(
    {"cat", "stack", "gather", "scatter", "scatter_", "scatter_add", "scatter_add_", "index_add", "index_add_", "index_copy",
     "index_copy_", "index_select", "searchsorted", "bucketize", "mm", "bmm", "addmm", "dot", "take", "scatter_reduce"}
)  # fmt: skip
#: Operators whose result has a size that the device has to tell, or that read an error code from it.
_WAITING = frozenset(
    {"nonzero", "masked_select", "_unique2", "unique_dim", "unique_consecutive", "bincount", "equal", "_linalg_check_errors"}
)  # fmt: skip
#: Operators whose result is a number on the host.
_READING = frozenset({"_local_scalar_dense"})
#: Operators that CUDA's kernels round in another way than the CPU's.
_ROUNDS = frozenset(
    {"sum", "mean", "cumsum", "prod", "cumprod", "logsumexp", "_softmax", "norm", "linalg_vector_norm", "var", "std",
     "mm", "bmm", "mv", "dot", "addmm", "addmv", "baddbmm", "addcmul", "addcdiv", "lerp", "rsqrt", "pow", "exp", "exp2",
     "expm1", "log", "log2", "log10", "log1p", "sin", "cos", "tan", "asin", "acos", "atan", "atan2", "sinh", "cosh",
     "tanh", "hypot", "sigmoid", "erf", "erfinv", "index_add", "scatter_add", "_linalg_det", "_linalg_solve_ex",
     "linalg_inv_ex", "linalg_cross"}
)  # fmt: skip
#: Functions of torch that make tensors, and methods of tensors that do.
_FACTORIES = (
    "arange", "empty", "empty_like", "eye", "full", "full_like", "linspace", "logspace", "ones", "ones_like", "rand",
    "rand_like", "randint", "randn", "randn_like", "randperm", "sparse_coo_tensor", "tensor", "zeros", "zeros_like",
)  # fmt: skip
_NEW = ("new_empty", "new_full", "new_ones", "new_zeros")


@dataclass
class Log:
    """Counts of what was done on the device. Lines are those of the package that asked, such as ``search/lbvh.py:120``.

    Attributes:
        operators: number of calls of each operator.
        waits: times that the host waited for the device, by line; copies are among them, as torch waits for both kinds.
        transfers: copies from the device to the host, by line.
        uploads: copies from the host to the device, by line.
        bytes: bytes that were copied to the host.
    """

    operators: collections.Counter[str] = field(default_factory=collections.Counter)
    waits: collections.Counter[str] = field(default_factory=collections.Counter)
    transfers: collections.Counter[str] = field(default_factory=collections.Counter)
    uploads: collections.Counter[str] = field(default_factory=collections.Counter)
    bytes: int = 0

    def clear(self) -> None:
        """Set all counts to zero."""
        for counts in (self.operators, self.waits, self.transfers, self.uploads):
            counts.clear()
        self.bytes = 0

    def waits_in(self, *files: str) -> int:
        """Return the waits in these files of the package, such as ``search/lbvh.py``."""
        return sum(n for line, n in self.waits.items() if line.partition(":")[0] in files)

    def add_transfer(self, size: int) -> None:
        """Count a copy of ``size`` bytes to the host, for which it waits."""
        line = _line()
        self.waits[line] += 1
        self.transfers[line] += 1
        self.bytes += size

    def add_upload(self) -> None:
        """Count a copy to the device."""
        line = _line()
        self.waits[line] += 1
        self.uploads[line] += 1

    def __str__(self) -> str:
        sums = [sum(x.values()) for x in (self.operators, self.waits, self.transfers, self.uploads)]
        text = (
            "{:,} operators; the host waited {:,} times, {:,} of these for transfers of {:,} bytes and {:,} for uploads"
        )
        lines = [text.format(*sums[:3], self.bytes, sums[3])]
        return "\n".join(lines + [f"  {n:6d} waits  {where}" for where, n in self.waits.most_common(16)])


_log = Log()


def _line() -> str:
    """Return file and line of the package that called."""
    frame = sys._getframe(1)
    while frame is not None:
        name = frame.f_code.co_filename
        if name.startswith(_PACKAGE):
            return f"{name[len(_PACKAGE) + 1 :]}:{frame.f_lineno}"
        frame = frame.f_back
    return "a test:0"


# ---- Tensors


class _Calls(threading.local):
    """Arguments of the calls of torch that Python made with device tensors among them, the innermost last."""

    def __init__(self) -> None:
        self.stack: list[tuple[Any, Any]] = []


_calls = _Calls()
_NO_OPTIONS: dict[str, Any] = {}
_HOST = torch.device("cpu")
_functorch: Any = torch._C._functorch  # pyright: ignore[reportAttributeAccessIssue]


class SimulatedTensor(torch.Tensor):
    """A tensor that says it is on ``cuda``.

    Attributes:
        inner: the CPU tensor that holds its numbers.
        on: the device that it says it is on.
    """

    inner: torch.Tensor  # pyright: ignore[reportIncompatibleMethodOverride]
    on: torch.device

    @staticmethod
    def __new__(cls, inner: torch.Tensor, on: torch.device) -> SimulatedTensor:
        make: Any = torch.Tensor._make_wrapper_subclass  # pyright: ignore[reportAttributeAccessIssue]
        if inner.layout == torch.strided:
            found = make(cls, inner.shape, inner.stride(), inner.storage_offset(), dtype=inner.dtype)
        else:
            found = make(cls, inner.shape, dtype=inner.dtype, layout=inner.layout)
        found.inner, found.on = inner, on
        return found

    def __init__(self, inner: torch.Tensor, on: torch.device) -> None:
        pass

    def __repr__(self) -> str:  # pyright: ignore[reportIncompatibleMethodOverride]
        return f"SimulatedTensor({self.inner!r})"

    def data_ptr(self) -> int:
        """Raise: code of the CPU cannot use the address of a device tensor."""
        raise RuntimeError(f"the address of a device tensor was asked for, at {_line()}")

    def __deepcopy__(self, memo: Any) -> SimulatedTensor:
        found = SimulatedTensor(self.inner.detach().clone(), self.on)
        found.requires_grad_(self.requires_grad)
        return found

    @classmethod
    def __torch_function__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        _calls.stack.append((args, kwargs))
        try:
            with torch._C.DisableTorchFunctionSubclass():
                return func(*args, **(kwargs or _NO_OPTIONS))
        finally:
            _calls.stack.pop()

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _run(func, args, kwargs or _NO_OPTIONS)


def _unwrapped(x: torch.Tensor) -> torch.Tensor:
    """Return the tensor under the wrappers of ``torch.func``."""
    while _functorch.is_functorch_wrapped_tensor(x):
        x = _functorch.get_unwrapped(x)
    return x


def _is_on_device(x: Any) -> bool:
    return isinstance(_unwrapped(x), SimulatedTensor)


def _inner(x: Any) -> Any:
    """Return the argument of an operator as the CPU takes it."""
    if isinstance(x, SimulatedTensor):
        return x.inner
    if isinstance(x, list | tuple):
        return [_inner(y) for y in x]
    return _HOST if isinstance(x, torch.device) else x


def _wrap(x: Any, on: torch.device) -> Any:
    """Return the result of an operator as tensors of the device."""
    if isinstance(x, torch.Tensor):
        return SimulatedTensor(x, on)
    return type(x)(_wrap(each, on) for each in x) if isinstance(x, list | tuple) else x


# ---- Operators


class _Operator(NamedTuple):
    """What has to be known of an operator.

    Attributes:
        name: its name, such as ``add``.
        checks: True: its arguments have to be looked at, or it makes the host wait.
        written: arguments that it writes and returns, by index or name.
    """

    name: str
    checks: bool
    written: tuple[int | str, ...]


@functools.cache
def _operator(func: Any) -> _Operator:
    if func.namespace not in ("aten", "prim", "prims"):
        raise NotImplementedError(f"{func}: no kernel of this operator for CUDA, at {_line()}")
    name, schema = func.overloadpacket.__name__, func._schema
    written: tuple[int | str, ...] = tuple(
        argument.name if argument.kwarg_only else i
        for i, argument in enumerate(schema.arguments)
        if argument.alias_info is not None and argument.alias_info.is_write
    )
    if not any(x.alias_info is not None and x.alias_info.is_write for x in schema.returns):
        written = ()
    return _Operator(name, name in _WAITING | _INDEXING | _READING | {"copy_", "repeat_interleave"}, written)


def _run(func: Any, args: Any, kwargs: Any) -> Any:
    """Run an operator with device tensors among its arguments, on the CPU."""
    operator = _operator(func)
    _log.operators[operator.name] += 1
    on = _device_of_operator(func, operator.name, args, _tensors([*args, *kwargs.values()]))
    if operator.checks:
        _count_wait(operator.name, args, kwargs)
    if kwargs:
        found = func(*map(_inner, args), **{key: _inner(value) for key, value in kwargs.items() if key != "pin_memory"})
    else:
        found = func(*map(_inner, args))
    if _machine["rounds"] and _rounds(operator.name, args):
        found = tree_map(_rounded_up, found)
    if operator.written:
        own = [args[key] if isinstance(key, int) else kwargs[key] for key in operator.written]
        return own[0] if len(own) == 1 else tuple(own)
    return _wrap(found, on)


def _rounds(name: str, args: Any) -> bool:
    """Return True if CUDA's kernel rounds in another way than the CPU's."""
    name = name.removesuffix("_")
    by_number = name == "div" and not isinstance(args[1], SimulatedTensor)
    return name in _ROUNDS or by_number or (name == "index_put" and len(args) > 3 and args[3])


def _rounded_up(x: Any) -> Any:
    """Return a tensor whose finite numbers other than 0 are the next larger ones, in place."""
    if isinstance(x, torch.Tensor) and x.is_floating_point():
        up = torch.nextafter(x, torch.full_like(x, torch.inf))
        return x.copy_(torch.where(torch.isfinite(up) & (x != 0), up, x))
    return x


def _count_wait(name: str, args: Any, kwargs: Any) -> None:
    """Count an operator if the host waits in it, or copies to the device."""
    if name in _READING or (name == "copy_" and not isinstance(args[0], SimulatedTensor)):
        _log.add_transfer(args[name == "copy_"].nbytes)
    elif name == "copy_":
        if not isinstance(args[1], SimulatedTensor) and args[1].dim():
            _log.add_upload()
    elif name == "repeat_interleave":
        _log.waits[_line()] += kwargs.get("output_size") is None
    elif name in _WAITING or _finds_mask(name, args):
        _log.waits[_line()] += 1


def _tensors(values: Sequence[Any]) -> list[torch.Tensor]:
    """Return the tensors among arguments of operators, which are values and lists of values."""
    found = []
    for x in values:
        if isinstance(x, torch.Tensor):
            found.append(x)
        elif isinstance(x, list | tuple):
            found += [y for y in x if isinstance(y, torch.Tensor)]
    return found


def _finds_mask(name: str, args: Any) -> bool:
    """Return True if an indexing operator has to find the True entries of a mask first."""
    if "put" in name and args[2].numel() == 1 and not (len(args) > 3 and args[3]):
        return False  # torch fills by the mask instead
    return any(isinstance(x, SimulatedTensor) and x.dtype in (torch.bool, torch.uint8) for x in args[1])


def _device_of_operator(func: Any, name: str, args: Any, tensors: Sequence[torch.Tensor]) -> torch.device:
    """Return the device of an operator.

    Raises:
        RuntimeError: its tensors are on several devices.
    """
    if name in _COPIES:
        return next(x.on for x in tensors if isinstance(x, SimulatedTensor))
    devices = {x.on for x in tensors if isinstance(x, SimulatedTensor)}
    if len(devices) > 1:
        raise RuntimeError(f"Expected all tensors to be on the same device, but found {devices}: {func}, at {_line()}")
    own = devices.pop()
    foreign = [x for x in tensors if not isinstance(x, SimulatedTensor) and (x.dim() > 0 or name in _STRICT)]
    if not foreign or (name in _INDEXING and isinstance(args[0], SimulatedTensor)):
        return own
    foreign = [x for x in foreign if not _made_by_autograd(x)]
    if foreign:
        shapes = ", ".join(str(tuple(x.shape)) for x in foreign)
        raise RuntimeError(
            f"Expected all tensors to be on the same device, but found at least two devices, {own} and cpu! "
            f"{func} with host tensors {shapes}, at {_line()}"
        )
    return own


def _made_by_autograd(x: torch.Tensor) -> bool:
    """Return True for a host tensor that C++ made within a call: no argument of that call has its memory."""
    if not _calls.stack:
        frame = sys._getframe()
        while frame is not None and frame.f_code.co_filename == __file__:
            frame = frame.f_back
        return frame is not None and frame.f_code.co_filename.endswith("torch/autograd/graph.py")  # the engine
    storage = x.untyped_storage()._cdata
    given = (y for y in tree_iter(_calls.stack[-1]) if isinstance(y, torch.Tensor) and not _is_on_device(y))
    return all(y.untyped_storage()._cdata != storage for y in given)


# ---- Between host and device


class _ToHost(torch.autograd.Function):
    """Copies to the host; derivatives go back to the device."""

    generate_vmap_rule = True

    @staticmethod
    def forward(x: torch.Tensor) -> torch.Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        own = _unwrapped(x)
        assert isinstance(own, SimulatedTensor)
        _log.add_transfer(own.nbytes)
        return own.inner.clone()

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        own = _unwrapped(inputs[0])
        assert isinstance(own, SimulatedTensor)
        ctx.on = own.on

    @staticmethod
    def backward(ctx: Any, grad: torch.Tensor) -> torch.Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        return grad if _is_on_device(grad) else SimulatedTensor(grad, ctx.on)


class _ToDevice(torch.autograd.Function):
    """Copies to a device; derivatives go back to where the tensor was."""

    generate_vmap_rule = True

    @staticmethod
    def forward(x: torch.Tensor, on: torch.device) -> torch.Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        _log.add_upload()
        return SimulatedTensor(_inner(_unwrapped(x)).detach().clone(), on)

    @staticmethod
    def setup_context(ctx: Any, inputs: Any, output: Any) -> None:
        ctx.back = getattr(_unwrapped(inputs[0]), "on", None)

    @staticmethod
    def backward(ctx: Any, grad: torch.Tensor) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        return (_inner(grad) if ctx.back is None else SimulatedTensor(_inner(grad), ctx.back)), None


# ---- What C++ answers without an operator: replaced while the simulation runs

_device_in_cpp = torch._C.TensorBase.device
_to, _cpu, _numpy, _tolist = (getattr(torch.Tensor, name) for name in ("to", "cpu", "numpy", "tolist"))
_make_tensor, _as_tensor = torch.tensor, torch.as_tensor


_nn: Any = torch._C._nn  # pyright: ignore[reportAttributeAccessIssue]


class _Cards(threading.local):
    """The current device of a thread."""

    current = 0


_cards = _Cards()
_machine: dict[str, Any] = {"count": 1, "name": "Simulated GPU", "rounds": False}


def _cuda_device(device: Any = None) -> torch.device:
    """Return a CUDA device with its index: the current one where none is named."""
    index = device if device is None or isinstance(device, int) else torch.device(device).index
    index = _cards.current if index is None else index
    if index >= _machine["count"]:
        raise RuntimeError("CUDA error: invalid device ordinal")
    return torch.device("cuda", index)


def _device(x: torch.Tensor) -> torch.device:
    own = _unwrapped(x)
    return own.on if isinstance(own, SimulatedTensor) else _device_in_cpp.__get__(x)


def _moved_to(self: torch.Tensor, *args: Any, **kwargs: Any) -> torch.Tensor:
    other = kwargs.pop("other", args[0] if args and isinstance(args[0], torch.Tensor) else None)
    if other is not None:
        args = (_device(other), other.dtype, *args[1:])
    copies = kwargs.get("copy", False)
    device, dtype, _, _ = _nn._parse_to(*args, **{k: v for k, v in kwargs.items() if k != "copy"})
    here = _device(self)
    if device is None or (device.type == "cpu" and here.type == "cpu"):
        return _to(self, *args, **kwargs)
    if device.type == "cuda" and _cuda_device(device) == here:  # C++ would find another device, and copy
        found = self if dtype is None else _to(self, dtype=dtype)
        return found.clone() if copies and found is self else found
    found = _ToHost.apply(self) if device.type == "cpu" else _ToDevice.apply(self, _cuda_device(device))
    return found if dtype is None else _to(found, dtype=dtype)  # pyright: ignore[reportCallIssue]


def _methods() -> dict[str, Any]:
    """Return methods and attributes of tensors, by the device that a tensor says it is on."""

    def cpu(self: torch.Tensor, *args: Any, **kwargs: Any) -> torch.Tensor:
        return _moved_to(self, "cpu") if _is_on_device(self) else _cpu(self, *args, **kwargs)

    def cuda(self: torch.Tensor, device: Any = None, *args: Any, **kwargs: Any) -> torch.Tensor:
        return _moved_to(self, _cuda_device(device))

    def numpy(self: torch.Tensor, *args: Any, **kwargs: Any) -> Any:
        if _is_on_device(self):
            text = "can't convert cuda:0 device type tensor to numpy. Use Tensor.cpu() to copy the tensor to host memory first."
            raise TypeError(f"{text} At {_line()}")
        return _numpy(self, *args, **kwargs)

    def tolist(self: torch.Tensor) -> Any:
        own = _unwrapped(self)
        if not isinstance(own, SimulatedTensor):
            return _tolist(self)
        _log.add_transfer(own.nbytes)
        return _tolist(own.inner)

    def new_tensor(self: torch.Tensor, data: Any, **kwargs: Any) -> torch.Tensor:
        return torch.tensor(data, **{"dtype": self.dtype, "device": _device(self), **kwargs})

    return {
        "to": _moved_to,
        "cpu": cpu,
        "cuda": cuda,
        "numpy": numpy,
        "tolist": tolist,
        "__array__": lambda self, *args, **kwargs: numpy(self).__array__(*args, **kwargs),
        "device": property(_device),
        "is_cuda": property(lambda x: _device(x).type == "cuda"),
        "is_cpu": property(lambda x: _device(x).type == "cpu"),
        "get_device": lambda x: _device(x).index if _device(x).type == "cuda" else -1,
        "new_tensor": new_tensor,
        **{name: _made_by(getattr(torch.Tensor, name)) for name in _NEW},
    }


def _made_by(factory: Any) -> Callable[..., torch.Tensor]:
    """Return a factory of tensors that knows the device: it makes them on the CPU, and wraps them."""

    @functools.wraps(factory)
    def make(*args: Any, device: Any = None, requires_grad: bool = False, **kwargs: Any) -> torch.Tensor:
        if device is None:
            return factory(*args, requires_grad=requires_grad, **kwargs)
        found = factory(*(x.inner if isinstance(x, SimulatedTensor) else x for x in args), device="cpu", **kwargs)
        if torch.device(device).type == "cuda":
            if factory is _make_tensor:
                _log.add_upload()
            found = SimulatedTensor(found, _cuda_device(device))
        return found.requires_grad_(requires_grad)

    return make


def _functions() -> dict[str, Any]:
    """Return functions of torch that make tensors."""

    def as_tensor(data: Any, dtype: Any = None, device: Any = None) -> torch.Tensor:
        found = data if isinstance(data, torch.Tensor) else _as_tensor(data, dtype=dtype)
        return found.to(device=device, dtype=dtype)

    return {"as_tensor": as_tensor} | {name: _made_by(getattr(torch, name)) for name in _FACTORIES}


class _Stream:
    """A stream of the device, on which everything is done already."""

    cuda_stream = 0

    def __init__(self, *args: Any, **kwargs: Any) -> None: ...

    def __enter__(self) -> _Stream:
        return self

    def __exit__(self, *args: Any) -> None: ...

    def synchronize(self) -> None: ...

    def wait_stream(self, other: Any) -> None: ...


def _set_device(device: Any) -> None:
    _cards.current = _cuda_device(device).index


def _cuda() -> dict[str, Any]:
    """Return functions of ``torch.cuda``."""
    return {
        "is_available": lambda: True,
        "is_initialized": lambda: True,
        "init": lambda: None,
        "_lazy_init": lambda: None,
        "device_count": lambda: _machine["count"],
        "current_device": lambda: _cards.current,
        "set_device": _set_device,
        "get_device_name": lambda device=None: _machine["name"],
        "get_device_capability": lambda device=None: (9, 0),
        "synchronize": lambda device=None: None,
        "empty_cache": lambda: None,
        "reset_peak_memory_stats": lambda device=None: None,
        "memory_allocated": lambda device=None: 0,
        "memory_reserved": lambda device=None: 0,
        "max_memory_allocated": lambda device=None: 0,
        "mem_get_info": lambda device=None: (16 << 30, 16 << 30),
        "current_stream": lambda device=None: _Stream(),
        "Stream": _Stream,
        "stream": lambda stream: stream,
    }


@contextlib.contextmanager
def simulated_cuda(cards: int = 1, name: str = "Simulated GPU", rounds: bool = False) -> Iterator[Log]:
    """Make ``device="cuda"`` work within the context, on all threads; yield the counts, which start at zero.

    Args:
        cards: number of devices.
        name: name of each.
        rounds: True: operators round as CUDA's may.
    """
    _machine.update(count=cards, name=name, rounds=rounds)
    _cards.current = 0
    _log.clear()
    nothing: Callable[..., bool] = lambda *args: False  # noqa: E731
    with contextlib.ExitStack() as stack:
        for place, values in (
            (torch.cuda, _cuda()),
            (torch, _functions()),
            # `nn.Module.to` replaces parameters: wrappers cannot become the data of CPU tensors.
            (torch, {"_has_compatible_shallow_copy_type": nothing}),
            (torch.Tensor, _methods()),
            # These run code of the package, and calls in there are looked at for themselves.
            (torch.autograd, {"has_torch_function": nothing}),
            (sys.modules["torch._tensor"], {"has_torch_function_unary": nothing}),
        ):
            for key, value in values.items():
                stack.callback(_restore, place, key, place.__dict__.get(key, _MISSING))
                setattr(place, key, value)
        yield _log


_MISSING = object()


def _restore(place: Any, key: str, value: Any) -> None:
    if value is _MISSING:
        delattr(place, key)
    else:
        setattr(place, key, value)


@contextlib.contextmanager
def without_compiled_functions() -> Iterator[None]:
    """Run all functions of tensors by operators, as a device does, within the context.

    On a CPU some run as kernels of the lane compiler, whose elementary functions round differently.
    """
    from torchpt.core.dispatch import Dispatched
    from torchpt.engines import dispatch  # registers the kernels  # noqa: F401
    from torchpt.math import hashing
    from torchpt.physics import samplers
    from torchpt.physics.lights import solid_angle, tree

    modules = (hashing, samplers, solid_angle, tree)
    functions = [x for module in modules for x in vars(module).values() if isinstance(x, Dispatched)]
    before = [list(function.implementations) for function in functions]
    try:
        for function in functions:
            function.implementations.clear()
        yield
    finally:
        for function, implementations in zip(functions, before, strict=True):
            function.implementations[:] = implementations
