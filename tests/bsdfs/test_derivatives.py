"""Derivatives by the numbers of materials, against differences over steps that are long beside the spacing of nodes.

A table is an integral by fixed nodes. Its autograd derivative agrees with differences over tiny steps even where it is wrong,
since both leave out the edges of the integrand that lie between nodes: those of total internal reflection and of the horizon.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any

import pytest
import torch
from cases import Values, cases_of, lanes, tensors
from torch import Tensor

from torchpt.math.vectors import normalize
from torchpt.physics import bsdfs
from torchpt.physics.bsdfs import Bsdf, Parameters
from torchpt.physics.bsdfs.base import Table

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")  # torch's, where it first meets forward mode

MODELS = bsdfs.variants()


def heavy(model: Bsdf) -> bool:
    """Energy tables of glass and of anisotropic facets take a second, their derivatives several."""
    return getattr(model, "energy_compensation", False) and (model.refracts or model.anisotropic)


def each(models: Iterable[Bsdf]) -> list[Any]:
    return [pytest.param(m, id=str(m), marks=[pytest.mark.slow] if heavy(m) else []) for m in models]


def numbers(values: Values, prefix: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """Return the path of each number or colour."""
    for key, value in values.items():
        if isinstance(value, dict):
            yield from numbers(value, (*prefix, key))
        else:
            yield (*prefix, key)


def with_number(values: Parameters, path: tuple[str, ...], factor: Tensor) -> Parameters:
    """Return the values with one of them multiplied."""
    key, *rest = path
    return {**values, key: with_number(values[key], tuple(rest), factor) if rest else values[key] * factor}


def check(value: Callable[[Tensor], Tensor], step: float, first: float, second: float, noise: float = 0.0) -> None:
    """Compare derivatives by a factor, at 1, with differences of fourth order.

    Args:
        value: the function.
        step: of the factor.
        first: relative tolerance of the first derivative.
        second: tolerance of the second derivative, relative to it and to the first.
        noise: absolute tolerance of both, over the value: what quadrature leaves.
    """
    x = torch.ones((), dtype=torch.float64, requires_grad=True)
    middle = value(x)
    if not middle.requires_grad:
        return
    slope = torch.autograd.grad(middle, x, create_graph=True)[0]
    curvature = torch.autograd.grad(slope, x)[0].item() if slope.requires_grad else 0.0
    forward = torch.func.jvp(value, (x.detach(),), (torch.ones_like(x),))[1].item()
    with torch.no_grad():
        f = {i: value(1.0 + i * step * torch.ones_like(x)).item() for i in (-2, -1, 0, 1, 2)}
    difference = (8.0 * (f[1] - f[-1]) - (f[2] - f[-2])) / (12.0 * step)
    bend = (16.0 * (f[1] + f[-1]) - (f[2] + f[-2]) - 30.0 * f[0]) / (12.0 * step**2)
    size = noise * abs(f[0])
    assert slope.item() == pytest.approx(difference, rel=first, abs=size + 1e-7), "first derivative"
    assert forward == pytest.approx(slope.item(), rel=1e-6, abs=1e-9), "forward mode"
    scale = second * max(abs(bend), abs(difference)) + size / step + 1e-6
    assert abs(curvature - bend) < scale, f"second derivative {curvature}, differences {bend}"


TABLES: list[Values] = [
    {"alpha": alpha, "int_ior": int_ior, "ext_ior": 1.0} for alpha, int_ior in ((0.1, 1.49), (0.3, 1.8), (0.6, 1.5))
]


@pytest.mark.parametrize("model", each([m for m in MODELS if m.tabulated]))
def test_tables(model):
    """Of a weighted sum of each table's entries; heavy tables have few nodes for their size."""
    for values in TABLES[1:2] if heavy(model) else TABLES:
        if model.anisotropic:
            values = {"alpha_u": 0.5 * values["alpha"], "alpha_v": values["alpha"], **values}
            del values["alpha"]
        at = tensors(values, torch.float64)
        for path in numbers(values):
            if not set(path) & set(model.tabulated):
                continue
            for name in model.tabulate(at):

                def value(x: Tensor, path: tuple[str, ...] = path, name: str = name, at: Parameters = at) -> Tensor:
                    table = model.tabulate(with_number(at, path, x))[name]
                    entries = table.values if isinstance(table, Table) else table
                    return (entries * torch.linspace(0.5, 1.5, len(entries), dtype=torch.float64)).mean()

                try:
                    # The noise is that of the differences: second derivatives agree with those by twice the nodes.
                    check(value, 0.06, 5e-3, 0.05, 4e-3 if heavy(model) else 4e-4)
                except AssertionError as error:
                    error.add_note(f"{name} of {values} by {path}")
                    raise


def directions(model: Bsdf) -> tuple[Tensor, Tensor]:
    """Return pairs above the surface, half of them nearly straight through if light passes, away from horizons and edges."""
    u = torch.quasirandom.SobolEngine(4, scramble=True, seed=3).draw(96, dtype=torch.float64).T
    wo, wi = (
        torch.stack(((1.0 - z * z).sqrt() * torch.cos(phi), (1.0 - z * z).sqrt() * torch.sin(phi), z))
        for z, phi in ((0.5 + 0.49 * u[0], 6.2 * u[1]), (0.5 + 0.49 * u[2], 6.2 * u[3]))
    )
    if model.transmits:
        wi = torch.where(torch.arange(wi.shape[1]) % 2 == 0, wi, -normalize(wo + 0.2 * wi))
    return wo, wi


@pytest.mark.parametrize("model", each(MODELS))
def test_values(model):
    """Of a weighted sum of ``eval`` at fixed directions, by each number and colour of a material with wide lobes."""
    case = max(
        (case for case in cases_of(model) if case.differentiable and not case.smooth),
        key=lambda case: case.narrowest if case.narrowest < 0.9 else 0.0,
        default=None,
    )
    if case is None:
        pytest.skip("nothing but deltas")
    at = tensors(case.values, torch.float64)
    wo, wi = directions(model)
    weights = torch.linspace(0.5, 1.5, wo.shape[1], dtype=torch.float64)
    for path in numbers(case.values):

        def value(x: Tensor, path: tuple[str, ...] = path) -> Tensor:
            rows = bsdfs.stacked([model.prepare(with_number(at, path, x))], model.factors)
            return (model.eval(lanes(rows, wo.shape[1]), wo, wi) * weights).mean()

        try:
            check(value, *((0.04, 0.01, 0.05, 1e-3) if model.tabulated else (0.02, 5e-3, 0.05, 1e-5)))
        except AssertionError as error:
            error.add_note(f"{case} by {path}")
            raise
