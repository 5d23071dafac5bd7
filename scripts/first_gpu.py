"""Check kernels on a GPU for the first time: ``python scripts/first_gpu.py [--device cuda:0] [--out report.json]``.

Twelve checks, from the first kernel to the time beside Mitsuba. A report in words goes to the terminal, line by line, and the
same as JSON to a file. What needs hardware or a program that is not there is "not measurable here". If the first four checks
pass, ``device=auto`` takes this card from then on (:mod:`torchpt.native.device_checks`).

``--simulated`` runs them with no GPU: kernels run on the CPU, one lane at a time (``tests/references/simulated_driver.py``).
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import json
import platform
import shutil
import statistics
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import torchpt
from torchpt.compiler import cache
from torchpt.compiler.function import compile_lanewise, trace_lanewise
from torchpt.compiler.kernel import HEAD, WORD
from torchpt.compiler.program import bind_tables
from torchpt.compiler.ptx import ptx_target
from torchpt.compiler.target import Target
from torchpt.core.errors import TorchptError
from torchpt.engines.kernels.device_backward import device_backward
from torchpt.engines.kernels.device_forward import MAX_LANES, DeviceForward, device_forward
from torchpt.engines.kernels.driver import Cuda, cuda_of
from torchpt.gradients import replay
from torchpt.native import device_checks
from torchpt.native.device_checks import CheckResult
from torchpt.rendering import run as renders
from torchpt.rendering.api import Rendering, render_scene
from torchpt.scene.formats.description import settings
from torchpt.scene.prepare import own_models

SCENES = (
    "cornell_box",
    "veach_mis",
    "cornell_transmissive",
    "cornell_specular",
    "thin_lens",
    "many_lights",
    "ibl_row",
    "cornell_bunny",
    "shapes_and_maps",
    "instances",
)
#: Checks that have to pass before ``device=auto`` takes the card.
DECISIVE = (1, 2, 3, 4)


class NotMeasurable(Exception):
    """Raised by a check for which hardware or a program is missing."""


class Differs(Exception):
    """Raised by a check whose numbers are not the expected ones; ``figures``: those numbers, by name."""

    def __init__(self, words: str, figures: dict[str, Any]) -> None:
        super().__init__(words)
        self.figures = figures


@dataclass
class Outcome:
    """The outcome of a check.

    Attributes:
        number: of the check.
        name: what it asks.
        status: passed, failed, or not measurable here.
        words: one line for people.
        figures: numbers by name.
        seconds: how long it took.
    """

    number: int
    name: str
    status: str
    words: str
    figures: dict[str, Any] = field(default_factory=dict)
    seconds: float = 0.0


# ---- Renders on the device


class Device:
    """The device under test, and renders on it.

    Args:
        name: of the device; of no importance if simulated.
        simulated: True: kernels run on the CPU.
        pixels: side of the pictures.
    """

    def __init__(self, name: str, simulated: bool, pixels: int) -> None:
        self.simulated, self.pixels = simulated, pixels
        self.lanes = 2048 if simulated else MAX_LANES
        self.order: int | None = None
        if simulated:
            sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "references"))
            from simulated_driver import SimulatedCuda, simulated_target

            self.torch = torch.device("cpu")
            self.cuda: Cuda = SimulatedCuda()
            self._simulated_target = simulated_target
        else:
            self.torch = torch.device(name)
            if self.torch.index is None:
                self.torch = torch.device(self.torch.type, torch.cuda.current_device())
            self.cuda = cuda_of(self.torch)

    @property
    def title(self) -> str:
        """Return the name of the card."""
        return "simulated driver" if self.simulated else device_checks.card_name(self.torch)

    def target(self, row: int) -> Target:
        """Return the target of kernels."""
        return self._simulated_target(row, self.order) if self.simulated else ptx_target(row)

    def picture(self, name: str, spp: int = 2, **keys: Any) -> Rendering:
        """Render a scene by kernels on the device."""

        def engine(scene: Any, wave: Any, *rest: Any) -> DeviceForward:
            by_kernels = self.simulated or rest[0].render.search_by_kernels
            return device_forward(wave, own_models(scene, wave), by_kernels, None, self.cuda, self.target, self.lanes)

        kept = renders.kernel_engine, renders.device_engine
        renders.kernel_engine = renders.device_engine = engine  # type: ignore[assignment]
        try:
            return _rendered(name, self.torch, self.pixels, spp, "on", **keys)
        finally:
            renders.kernel_engine, renders.device_engine = kept

    def gradients(self, *names: str) -> list[Tensor]:
        """Return gradients of the Cornell box by kernels on the device, see :func:`_gradients`."""

        def backward(kernels: Any, tape: Any, settings: Any, cotangent: Tensor, sums: Any) -> str:
            return replay._replay_on_device([], tape, settings, cotangent, kernels.cotangent, sums, None)

        def made(tape: Any, own: Any, cotangent: Any, by_kernels: bool, lanes: int, before: Any) -> Any:
            return device_backward(tape, own, cotangent, by_kernels, lanes, before, self.cuda, self.target)

        kept = replay._replay_on_threads, replay.device_backward
        if self.simulated:
            replay._replay_on_threads, replay.device_backward = backward, made
        try:
            return _gradients(self.pixels, self.torch, *names)
        finally:
            replay._replay_on_threads, replay.device_backward = kept

    def wait(self) -> None:
        """Wait for the device."""
        if not self.simulated:
            torch.cuda.synchronize(self.torch)

    def needs_hardware(self) -> None:
        """Raise :class:`NotMeasurable` if simulated."""
        if self.simulated:
            raise NotMeasurable("needs a GPU")


def _rendered(name: str, device: torch.device, pixels: int, spp: int, mode: str, **keys: Any) -> Rendering:
    scene = torchpt.load(name, device)
    film = {"width": pixels, "height": pixels * 3 // 4, "filter": "box"}
    wish = {"film": film, "render": {"spp": spp, "seed": 1, "compile": mode}, **keys}
    return render_scene(scene, settings(scene.description, wish))


def _on_cpu(device: Device, name: str, spp: int = 2, **keys: Any) -> Rendering:
    return _rendered(name, torch.device("cpu"), device.pixels, spp, "on", **keys)


def _differing(a: Tensor, b: Tensor) -> int:
    """Return how many numbers differ in their bits; all NaNs count as equal."""
    a, b = a.cpu(), b.cpu()
    return int(((a != b) & ~((a != a) & (b != b))).sum())


def _require(holds: bool, words: str, figures: dict[str, Any]) -> None:
    """Raise :class:`Differs` unless something holds."""
    if not holds:
        raise Differs(words, figures)


def _prepared(
    device: Device, function: Callable[..., Any], inputs: list[Tensor]
) -> tuple[list[Tensor], Callable[[Tensor], None]]:
    """Make one kernel of a function of lanes; return its results and what launches it for a number of lanes ``(1,)`` int64."""
    stage, like = trace_lanewise(function, inputs)
    program = cache.compile_stage(stage, device.target(1024))
    tables = bind_tables(stage.tables, stage.steps, stage.constants, {}, device=device.torch)
    count = inputs[0].shape[-1]
    given = [x.to(device.torch).contiguous() for x in inputs]
    results = [torch.empty((*x.shape[:-1], count), dtype=x.dtype, device=device.torch) for x in like]
    words = (ctypes.c_int64 * (len(HEAD) + 2 * (len(given) + len(results))))()
    words[WORD["tables"]] = tables.address
    for k, x in enumerate((*given, *results)):
        words[len(HEAD) + 2 * k], words[len(HEAD) + 2 * k + 1] = x.data_ptr(), count
    code = device.cuda.load(program.function.code, program.function.key)

    def launch(lanes: Tensor, _keep: Any = (given, tables)) -> None:  # tensors whose addresses are among the words
        device.cuda.launch(code, words, lanes.data_ptr(), count, device.cuda.stream())

    device.cuda.enter()
    return results, launch


def _run(device: Device, function: Callable[..., Any], inputs: list[Tensor]) -> list[Tensor]:
    """Run a function of lanes as one kernel on the device."""
    results, launch = _prepared(device, function, inputs)
    launch(torch.tensor([inputs[0].shape[-1]], dtype=torch.int64, device=device.torch))
    device.wait()
    return [x.cpu() for x in results]


# ---- The checks


def first_kernels(device: Device) -> tuple[str, dict[str, Any]]:
    """Check 1: kernels load, and a picture of a few pixels of every scene has the CPU's bits."""
    wrong, figures = [], {}
    kept, device.pixels = device.pixels, 8
    try:
        for name in SCENES:
            found, expected = device.picture(name, 1), _on_cpu(device, name, 1)
            figures[name] = _differing(found.image, expected.image)
            if figures[name] or found.rays != expected.rays:
                wrong.append(name)
    finally:
        device.pixels = kept
    functions = device.cuda.functions()
    figures["kernels"] = len(functions)
    figures["most_registers"] = max((function.registers for function in functions), default=0)
    figures["most_local_bytes"] = max((function.local_bytes for function in functions), default=0)
    _require(not wrong, f"these scenes differ from the CPU: {', '.join(wrong)}", figures)
    return f"{len(functions)} kernels of {len(SCENES)} scenes gave the CPU's bits", figures


def _arithmetic(a: Tensor, b: Tensor, c: Tensor) -> tuple[Tensor, ...]:
    return a / b, torch.sqrt(a.abs()), 1.0 / b, torch.addcmul(c, a, b)


def arithmetic(device: Device) -> tuple[str, dict[str, Any]]:
    """Check 2: quotients, roots, reciprocals and fused products of random pairs have the CPU's bits, in both precisions."""
    pairs = 100_000 if device.simulated else 10_000_000
    generator = torch.Generator().manual_seed(1)
    figures: dict[str, Any] = {"pairs": pairs}
    for dtype in (torch.float32, torch.float64):
        exponent = torch.randint(-60, 60, (3, pairs), generator=generator)
        values = torch.ldexp(torch.randn(3, pairs, generator=generator, dtype=torch.float64), exponent).to(dtype)
        inputs = list(values.unbind())
        expected = compile_lanewise(_arithmetic, inputs)(*inputs)
        found = _run(device, _arithmetic, inputs)
        for name, a, b in zip(("quotient", "root", "reciprocal", "fused"), found, expected, strict=True):
            figures[f"{name} {str(dtype).removeprefix('torch.')}"] = _differing(a, b)
    wrong = [name for name, count in figures.items() if count and name != "pairs"]
    _require(not wrong, f"these differ from the CPU: {', '.join(wrong)}", figures)
    return f"{pairs} random pairs gave the CPU's bits in float32 and float64", figures


def pictures(device: Device) -> tuple[str, dict[str, Any]]:
    """Check 3: whole pictures of ten scenes have the CPU's bits, and their numbers of rays."""
    figures, wrong = {}, []
    for name in SCENES:
        found, expected = device.picture(name), _on_cpu(device, name)
        figures[name] = _differing(found.image, expected.image)
        if figures[name] or (found.rays, found.nonfinite_samples) != (expected.rays, expected.nonfinite_samples):
            wrong.append(name)
    _require(not wrong, f"these scenes differ from the CPU: {', '.join(wrong)}", figures)
    return f"{len(SCENES)} pictures gave the CPU's bits", figures


def repeated(device: Device) -> tuple[str, dict[str, Any]]:
    """Check 4: the same picture twice, by other blocks, by smaller waves, and on another stream."""
    name = "cornell_box"
    first, figures = device.picture(name), {}

    def again(label: str) -> None:
        found = device.picture(name)
        figures[label] = _differing(found.image, first.image) + abs(found.rays - first.rays)

    again("twice")
    kept = device.cuda.threads, device.lanes, device.order
    try:
        for threads in () if device.simulated else (32, 64, 256):  # the simulated driver has no blocks
            device.cuda.threads = threads
            again(f"blocks of {threads}")
        device.cuda.threads = kept[0]
        device.lanes = 1024
        again("waves of 1024")
        device.lanes = kept[1]
        if device.simulated:
            device.order = 0
            again("another order of lanes")
    finally:
        device.cuda.threads, device.lanes, device.order = kept
    if not device.simulated:
        with torch.cuda.stream(torch.cuda.Stream(device.torch)):
            again("another stream")
    wrong = [label for label, count in figures.items() if count]
    _require(not wrong, f"these differ from the first picture: {', '.join(wrong)}", figures)
    return f"{len(figures)} more pictures had the same bits", figures


def times(device: Device) -> tuple[str, dict[str, Any]]:
    """Check 5: paths a second by size of blocks, and the time of a launch without lanes."""
    device.needs_hardware()
    figures: dict[str, Any] = {}
    kept = device.pixels, device.cuda.threads
    device.pixels = 512
    try:
        for threads in (64, 128, 256):
            device.cuda.threads = threads
            for name in ("cornell_box", "veach_mis", "cornell_bunny"):
                device.picture(name, 16)
                done = [device.picture(name, 16) for _ in range(3)]
                best = max(one.paths / one.render_seconds for one in done)
                figures[f"{name}, blocks of {threads}, Mpaths/s"] = round(best / 1e6, 2)
    finally:
        device.pixels, device.cuda.threads = kept
    figures["launch, microseconds"] = _launch_seconds(device) * 1e6
    best_name = max((name for name in figures if "Mpaths" in name), key=lambda name: figures[name])
    return f"best {best_name}: {figures[best_name]}", figures


def _launch_seconds(device: Device) -> float:
    """Return the seconds of a launch without lanes."""
    count = 200
    _, launch = _prepared(device, _arithmetic, [torch.ones(1 << 20) for _ in range(3)])
    lanes = torch.zeros(1, dtype=torch.int64, device=device.torch)
    launch(lanes)
    device.wait()
    start = time.perf_counter()
    for _ in range(count):
        launch(lanes)
    device.wait()
    return (time.perf_counter() - start) / count


def profile(device: Device) -> tuple[str, dict[str, Any]]:
    """Check 6: issue slots, threads at work, caches and local memory, by Nsight Compute."""
    device.needs_hardware()
    if shutil.which("ncu") is None:
        raise NotMeasurable("needs Nsight Compute (ncu)")
    command = f"ncu --set full {sys.executable} -m torchpt render cornell_box device={device.torch} compile=on spp=16"
    raise NotMeasurable(f"run it by hand: {command}")


def compile_times(device: Device) -> tuple[str, dict[str, Any]]:
    """Check 7: seconds in which the driver compiles kernels, first and again from its cache."""
    device.needs_hardware()
    seconds = [function.seconds for function in device.cuda.functions()]
    figures = {"kernels": len(seconds), "first, seconds": sum(seconds), "slowest, seconds": max(seconds, default=0.0)}
    again = Cuda(device.torch)
    kept, device.cuda = device.cuda, again
    try:
        for name in SCENES[:3]:
            device.picture(name, 1)
        figures["again, three scenes, seconds"] = sum(function.seconds for function in again.functions())
    finally:
        device.cuda = kept
    return f"{len(seconds)} kernels in {sum(seconds):.1f} s, the slowest in {max(seconds, default=0.0):.1f} s", figures


def memory(device: Device) -> tuple[str, dict[str, Any]]:
    """Check 8: a wave that runs out of memory goes on with fewer lanes, for the same picture."""
    device.needs_hardware()
    expected = device.picture("cornell_box", 4)
    torch.cuda.empty_cache()
    total = torch.cuda.get_device_properties(device.torch).total_memory
    torch.cuda.set_per_process_memory_fraction((160 << 20) / total, device.torch)
    try:
        found = device.picture("cornell_box", 4)
    finally:
        torch.cuda.set_per_process_memory_fraction(1.0, device.torch)
    figures = {"lanes": found.lanes, "differing": _differing(found.image, expected.image)}
    _require(not figures["differing"], "the picture differs after memory ran out", figures)
    return f"waves of {found.lanes} lanes gave the same picture", figures


def search(device: Device) -> tuple[str, dict[str, Any]]:
    """Check 9: rays a second in a tree, which kernels search."""
    device.needs_hardware()
    done = [device.picture("cornell_bunny", 4) for _ in range(3)]
    rate = max(one.rays / one.render_seconds for one in done) / 1e6
    return f"{rate:.2f} Mrays/s in the tree of cornell_bunny", {"Mrays/s": rate}


def gradients(device: Device) -> tuple[str, dict[str, Any]]:
    """Check 10: gradients twice, and the CPU's: colours by bits, what moves as near as tensor operations allow."""
    colours, moving = (
        ("materials.white.reflectance", "shapes.lamp.emission"),
        ("shapes.short_box.vertices", "camera.to_world"),
    )
    first, second = device.gradients(*colours, *moving), device.gradients(*colours, *moving)
    expected = _gradients(device.pixels, torch.device("cpu"), *colours, *moving)
    figures: dict[str, Any] = {"differing in two runs": sum(map(_differing, first, second))}
    for name, found, wanted in zip((*colours, *moving), first, expected, strict=True):
        figures[f"{name}, differing from the CPU"] = _differing(found, wanted)
        figures[f"{name}, of the largest"] = float((found - wanted).abs().max() / wanted.abs().max())
    wrong = [name for name in colours if figures[f"{name}, differing from the CPU"]]
    # Gradients of camera rays are tensor operations, whose sums round differently on a GPU.
    wrong += [name for name in moving if figures[f"{name}, of the largest"] > 1e-3]
    _require(not figures["differing in two runs"], "two runs differ", figures)
    _require(not wrong, f"these differ from the CPU: {', '.join(wrong)}", figures)
    bits = sum(figures[f"{name}, differing from the CPU"] for name in moving)
    return f"colours gave the CPU's bits; of what moves {bits} numbers differ", figures


def _gradients(pixels: int, where: torch.device, *names: str) -> list[Tensor]:
    """Return gradients of a weighted mean of a picture of the Cornell box, by kernels and without edges."""
    scene = torchpt.load("cornell_box", where)
    values = {name: scene.params[name].clone().requires_grad_() for name in names}
    film = {"width": pixels, "height": pixels * 3 // 4, "filter": "box"}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", torchpt.EdgeWarning)
        image = torchpt.render(scene, spp=4, seed=1, params=values, film=film, compile="on", edges=False)
    weights = torch.rand(image.shape, generator=torch.Generator().manual_seed(2)).to(image.device)
    return [x.cpu() for x in torch.autograd.grad((image * weights).mean(), list(values.values()))]


def float64_share(device: Device) -> tuple[str, dict[str, Any]]:
    """Check 11: what float64 costs on this card: the time of the same operations in both precisions."""
    device.needs_hardware()
    figures: dict[str, Any] = {}
    for dtype in (torch.float32, torch.float64):
        values = [torch.rand(1 << 22, dtype=dtype) + 0.5 for _ in range(3)]
        _run(device, _arithmetic, values)
        seconds = []
        for _ in range(5):
            start = time.perf_counter()
            _run(device, _arithmetic, values)
            seconds.append(time.perf_counter() - start)
        figures[f"{dtype}, seconds with transfers"] = statistics.median(seconds)
    return ", ".join(f"{name}: {value:.4f}" for name, value in figures.items()), figures


def mitsuba(device: Device) -> tuple[str, dict[str, Any]]:
    """Check 12: beside Mitsuba's CUDA variant on the same card."""
    device.needs_hardware()
    try:
        import mitsuba as mi  # pyright: ignore[reportMissingImports]

        mi.set_variant("cuda_ad_rgb")
    except (ImportError, AttributeError) as error:
        raise NotMeasurable(f"needs mitsuba with cuda_ad_rgb ({error})") from None
    command = f"{sys.executable} scripts/bench_mitsuba.py"
    raise NotMeasurable(f"mitsuba runs here; compare by hand: {command}")


CHECKS: tuple[tuple[str, Callable[[Device], tuple[str, dict[str, Any]]]], ...] = (
    ("first kernels, by bits", first_kernels),
    ("division, roots and fused products, by bits", arithmetic),
    ("whole pictures, by bits", pictures),
    ("the same picture again: blocks, waves, streams", repeated),
    ("time by size of blocks, and of a launch", times),
    ("profile", profile),
    ("the driver's compile time", compile_times),
    ("running out of memory", memory),
    ("rays a second in a tree", search),
    ("gradients", gradients),
    ("what float64 costs", float64_share),
    ("beside Mitsuba", mitsuba),
)


def checked(device: Device, numbers: list[int]) -> Iterator[Outcome]:
    """Run checks, and yield their outcomes; an error is a failed check, not the end."""
    for number, (name, check) in enumerate(CHECKS, 1):
        if number not in numbers:
            continue
        start = time.perf_counter()
        try:
            words, figures = check(device)
            outcome = Outcome(number, name, "passed", words, figures)
        except NotMeasurable as error:
            outcome = Outcome(number, name, "not measurable here", str(error))
        except Differs as error:
            outcome = Outcome(number, name, "failed", str(error), error.figures)
        except Exception as error:
            place = traceback.extract_tb(error.__traceback__)[-1]
            where = "" if isinstance(error, TorchptError) else f" ({Path(place.filename).name}:{place.lineno})"
            outcome = Outcome(number, name, "failed", f"{error or type(error).__name__}{where}")
        outcome.seconds = round(time.perf_counter() - start, 2)
        yield outcome


def main(words: list[str] | None = None) -> int:
    """Run the checks; return 1 if one failed, 2 if there is no device."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda", help="cuda or cuda:N")
    parser.add_argument("--simulated", action="store_true", help="run kernels on the CPU, as a device would")
    parser.add_argument("--out", type=Path, default=Path("first_gpu.json"), help="where the report goes, as JSON")
    parser.add_argument("--pixels", type=int, default=64, help="width of the pictures")
    parser.add_argument("--only", type=int, nargs="*", help="numbers of checks; all by default")
    arguments = parser.parse_args(words)
    try:
        missing = None if arguments.simulated else device_checks.why_unavailable()
        if missing is not None:
            raise TorchptError(f"no GPU to check, as {missing}; --simulated runs the checks without one")
        device = Device(arguments.device, arguments.simulated, arguments.pixels)
    except TorchptError as error:
        print(f"first_gpu: {error}", file=sys.stderr)
        return 2
    numbers = arguments.only or list(range(1, len(CHECKS) + 1))
    driver = "" if device.simulated else device_checks.driver_version()
    print(
        f"{device.title}, driver {driver or 'none'}, torch {torch.__version__}, torchpt {torchpt.__version__}",
        flush=True,
    )
    outcomes: list[Outcome] = []
    with _shuffled(device):
        for outcome in checked(device, numbers):
            outcomes.append(outcome)
            print(
                f"{outcome.number:2} {outcome.name}: {outcome.status}: {outcome.words} [{outcome.seconds} s]",
                flush=True,
            )
    report = {
        "card": device.title,
        "driver": driver,
        "torch": torch.__version__,
        "torchpt": torchpt.__version__,
        "machine": platform.processor() or platform.machine(),
        "checks": [asdict(outcome) for outcome in outcomes],
    }
    arguments.out.write_text(json.dumps(report, indent=1) + "\n")
    failed = [outcome for outcome in outcomes if outcome.status == "failed"]
    decisive = [outcome for outcome in outcomes if outcome.number in DECISIVE]
    if not device.simulated and len(decisive) == len(DECISIVE):
        passed = all(outcome.status == "passed" for outcome in decisive)
        detail = next((f"{one.name}: {one.words}" for one in decisive if one.status != "passed"), decisive[2].words)
        device_checks.record(CheckResult(device.title, driver, passed, detail))
        print("device=auto takes this card" if passed else "device=auto does not take this card")
    return int(bool(failed))


def _shuffled(device: Device) -> contextlib.AbstractContextManager[None]:
    """Return the context in which a simulated device knows random orders of lanes."""
    if not device.simulated:
        return contextlib.nullcontext()
    from simulated_driver import shuffled_lanes

    return shuffled_lanes()


if __name__ == "__main__":
    sys.exit(main())
