"""Parameters to try each model with: plain numbers as a scene gives them, from one end of their ranges to the other."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from torchpt.physics import bsdfs
from torchpt.physics.bsdfs import Bsdf, Parameters
from torchpt.spec import REQUIRED, Color, Scalar, parameters_of

RED = (0.8, 0.5, 0.1)
WHITE = (1.0, 1.0, 1.0)
BLACK = (0.0, 0.0, 0.0)
GOLD = {"eta": (0.143, 0.375, 1.442), "k": (3.983, 2.386, 1.603)}

Values = dict[str, Any]  #: numbers, colours as tuples, and such mappings again


@dataclass(frozen=True)
class Case:
    """One material.

    Attributes:
        model: of ``bsdfs.variants()``.
        values: what ``prepare`` is given.
        eta: index of the inside over that of the outside, where it refracts.
        lossless: nothing is absorbed or lost between facets: a white furnace shows 1.
        furnace: how far from 1 the furnace may be where it is lossless: energy tables are linear between few cosines.
        conserves: whether this material may not create energy.
        smooth: nothing but deltas.
        differentiable: wide enough lobes for finite differences of eval.
    """

    model: Bsdf
    values: Values
    eta: float = 1.0
    lossless: bool = False
    furnace: float = 0.0
    conserves: bool = True
    smooth: bool = False
    differentiable: bool = True
    label: str = field(default="", compare=False)

    def __str__(self) -> str:
        return f"{self.model}: {self.label or brief(self.values)}".replace("[", "(").replace("]", ")")

    @property
    def narrowest(self) -> float:
        """The smallest alpha of a lobe that is no delta; 1 where no lobe has one."""
        return _narrowest(self.values)

    def rows(self, dtype: torch.dtype = torch.float32) -> Parameters:
        """The material as stacked rows of its model."""
        if dtype not in self._rows:
            self._rows[dtype] = bsdfs.stacked([self.model.prepare(tensors(self.values, dtype))], self.model.factors)
        return self._rows[dtype]

    @cached_property
    def _rows(self) -> dict[torch.dtype, Parameters]:
        """Those already asked for: the tables of some models take a second."""
        return {}


def _narrowest(values: Values) -> float:
    inner = [_narrowest(value) for value in values.values() if isinstance(value, dict)]
    own = _alphas({key: value for key, value in values.items() if key in ("alpha", "alpha_u", "alpha_v", "roughness")})
    # Blinn's exponent as a roughness; Phong's lobe is none of facets, but is as narrow.
    powers = [(2.0 / (values["exponent"] + 2.0)) ** 0.5] if "exponent" in values else []
    return min([1.0, *inner, *powers, *(max(alpha, 1e-4) for alpha in own)])


def brief(values: Values) -> str:
    words = []
    for key, value in values.items():
        if isinstance(value, dict):
            words.append(f"{key} {{{brief(value)}}}")
        elif isinstance(value, tuple):
            words.append(f"{key} {'/'.join(f'{x:g}' for x in value)}")
        else:
            words.append(f"{key} {value:g}")
    return " ".join(words)


def tensors(values: Values, dtype: torch.dtype) -> Parameters:
    """Numbers ``(1,)``, colours ``(3, 1)``."""
    out: Parameters = {}
    for key, value in values.items():
        if isinstance(value, dict):
            out[key] = tensors(value, dtype)
        else:
            column = torch.tensor(value, dtype=dtype)
            out[key] = column.reshape(3, 1) if isinstance(value, tuple) else column.reshape(1)
    return out


def lanes(rows: Parameters, n: int, row: int = 0) -> Parameters:
    return bsdfs.gather(rows, torch.full((n,), row, dtype=torch.int64))


def is_smooth(rough: Values) -> bool:
    return bool(rough) and all(value < 0.99e-4 for value in _alphas(rough))


def _alphas(rough: Values) -> list[float]:
    return [value * value if key == "roughness" else value for key, value in rough.items()]


def _is_wide(rough: Values) -> bool:
    return all(value >= 0.01 for value in _alphas(rough))


def _roughness(model: Bsdf) -> list[Values]:
    """Lobes from the narrowest to the widest."""
    if model.anisotropic:
        pairs = [(0.1, 0.4), (1.0, 0.01), (1e-4, 0.3), (0.05, 0.5), (1.0, 1.0)]
        return [{"alpha_u": u, "alpha_v": v} for u, v in pairs]
    return [*({"alpha": alpha} for alpha in (1e-4, 0.01, 0.1, 0.5, 1.0)), {"roughness": 0.6}]


def _edge_roughness(model: Bsdf) -> list[Values]:
    if model.anisotropic:
        return [{"alpha_u": u, "alpha_v": v} for u, v in ((0.0, 0.0), (0.0, 1.0), (1.0, 1e-4), (1e-4, 1e-4))]
    return [*({"alpha": alpha} for alpha in (0.0, 0.9e-4, 1e-4, 1.0)), {"roughness": 0.0}, {"roughness": 1.0}]


def _diffuse(model: Bsdf) -> Iterator[Case]:
    for colour in (RED, WHITE, (1.0, 0.0, 0.3)):
        yield Case(model, {"reflectance": colour}, lossless=colour == WHITE)


def _diffuse_edges(model: Bsdf) -> Iterator[Case]:
    yield Case(model, {"reflectance": BLACK})
    yield Case(model, {"reflectance": WHITE})


def _rough_diffuse(model: Bsdf) -> Iterator[Case]:
    for colour, alpha in ((RED, 0.3), (WHITE, 1.0), (RED, 0.05), ((1.0, 0.0, 0.3), 0.6)):
        yield Case(model, {"reflectance": colour, "alpha": alpha})
    yield Case(model, {"reflectance": WHITE, "alpha": 0.0}, lossless=True)


def _rough_diffuse_edges(model: Bsdf) -> Iterator[Case]:
    for colour in (BLACK, WHITE):
        for alpha in (0.0, 1e-4, 1.0):
            yield Case(model, {"reflectance": colour, "alpha": alpha})


def _glossy(model: Bsdf) -> Iterator[Case]:
    for diffuse, specular, exponent in (
        (RED, (0.1, 0.15, 0.2), 30.0),
        (BLACK, WHITE, 5.0),
        ((0.3, 0.3, 0.3), (0.7, 0.7, 0.1), 0.0),
        (RED, (0.05, 0.05, 0.05), 1e3),
        ((0.2, 0.2, 0.5), (0.4, 0.4, 0.4), 1e5),
        (WHITE, BLACK, 10.0),
    ):
        yield Case(
            model,
            {"diffuse": diffuse, "specular": specular, "exponent": exponent},
            conserves=all(d + s <= 1 for d, s in zip(diffuse, specular, strict=True)),
            differentiable=exponent <= 1e3,
        )


def _glossy_edges(model: Bsdf) -> Iterator[Case]:
    for diffuse, specular in ((BLACK, BLACK), (BLACK, WHITE), (WHITE, BLACK), (RED, RED)):
        for exponent in (0.0, 1.0, 1e5):
            yield Case(model, {"diffuse": diffuse, "specular": specular, "exponent": exponent})


def _metal(model: Bsdf) -> Values:
    return {"reflectance": (0.95, 0.64, 0.54)} if getattr(model, "schlick", False) else dict(GOLD)


def _mirror(model: Bsdf) -> Values:
    """F = 1 at every angle."""
    return {"reflectance": WHITE} if getattr(model, "schlick", False) else {"eta": BLACK, "k": WHITE}


def _conductor(model: Bsdf) -> Iterator[Case]:
    yield Case(model, _metal(model), smooth=True)
    yield Case(model, {**_metal(model), "specular_reflectance": RED}, smooth=True)
    yield Case(model, _mirror(model), smooth=True, lossless=True)


def _edge_metals(model: Bsdf) -> list[Values]:
    if getattr(model, "schlick", False):
        return [{"reflectance": WHITE}, {"reflectance": BLACK}]
    pairs = ((BLACK, WHITE), (WHITE, BLACK), (BLACK, BLACK), ((10.0, 1e-3, 1.00001), (0.0, 10.0, 1e-3)))
    return [{"eta": eta, "k": k} for eta, k in pairs]


def _conductor_edges(model: Bsdf) -> Iterator[Case]:
    for metal in _edge_metals(model):
        yield Case(model, metal)
        yield Case(model, {**metal, "specular_reflectance": BLACK})


def _rough_conductor(model: Bsdf) -> Iterator[Case]:
    compensated = getattr(model, "energy_compensation", False)
    for i, rough in enumerate(_roughness(model)):
        tint = {"specular_reflectance": RED} if i == 2 else {}
        # At 89.9 degrees the table of a compensated metal of alpha 1e-4 is 3e-4 off: E is linear between few cosines.
        between = 1e-3 if compensated else 0.0
        yield Case(model, {**_metal(model), **rough, **tint}, furnace=between, differentiable=_is_wide(rough))
    for rough in _roughness(model)[-2:] if compensated else _roughness(model)[-1:]:
        yield Case(model, {**_mirror(model), **rough}, lossless=compensated, furnace=0.01 if compensated else 0.0)
    smooth = {"alpha_u": 0.0, "alpha_v": 0.0} if model.anisotropic else {"alpha": 0.0}
    yield Case(model, {**_mirror(model), **smooth}, smooth=True, lossless=True)
    if model.anisotropic:
        yield Case(model, {**_metal(model), "alpha_u": 0.0, "alpha_v": 0.3}, differentiable=False)


def _rough_conductor_edges(model: Bsdf) -> Iterator[Case]:
    for rough in _edge_roughness(model):
        for metal in _edge_metals(model):
            yield Case(model, {**metal, **rough})
    yield Case(model, {**_metal(model), **_edge_roughness(model)[-1], "specular_reflectance": BLACK})


def _ior(eta: float) -> Values:
    return {"int_ior": 1.5 * eta, "ext_ior": 1.5} if eta < 1 else {"int_ior": eta, "ext_ior": 1.0}


ETAS = (1.5, 1 / 1.5, 1.0, 10.0)
EDGE_ETAS = (1.0, 1.00001, 1 / 1.5, 1e-3, 10.0)


def _dielectric(model: Bsdf) -> Iterator[Case]:
    for eta in (*ETAS, 1.33):
        yield Case(model, _ior(eta), eta, lossless=True, smooth=True)
    tints = {"specular_reflectance": RED, "specular_transmittance": (0.2, 0.9, 0.5)}
    yield Case(model, {**_ior(1.5), **tints}, 1.5, smooth=True)


def _dielectric_edges(model: Bsdf) -> Iterator[Case]:
    for eta in EDGE_ETAS:
        yield Case(model, _ior(eta), eta)
        yield Case(model, {**_ior(eta), "specular_reflectance": BLACK, "specular_transmittance": WHITE}, eta)
        yield Case(model, {**_ior(eta), "specular_reflectance": WHITE, "specular_transmittance": BLACK}, eta)


def _rough_dielectric(model: Bsdf) -> Iterator[Case]:
    compensated = getattr(model, "energy_compensation", False)
    roughs, furnace = _roughness(model), 0.01 if compensated else 0.0
    for rough in roughs:
        lossless = compensated and not model.anisotropic
        wide = _is_wide(rough)
        yield Case(model, {**_ior(1.5), **rough}, 1.5, lossless=lossless, furnace=furnace, differentiable=wide)
    for eta in (1 / 1.5, 10.0, 1.1):
        rough = roughs[{1 / 1.5: 2, 10.0: 3, 1.1: 1}[eta]]
        yield Case(
            model, {**_ior(eta), **rough}, eta, lossless=compensated, furnace=furnace, differentiable=_is_wide(rough)
        )
    yield Case(model, {**_ior(1.0), **roughs[2]}, 1.0, smooth=True, lossless=True)  # straight through
    tints = {"specular_reflectance": RED, "specular_transmittance": (0.2, 0.9, 0.5)}
    yield Case(model, {**_ior(1.5), **roughs[3], **tints}, 1.5)
    smooth = {"alpha_u": 0.0, "alpha_v": 0.0} if model.anisotropic else {"alpha": 0.0}
    yield Case(model, {**_ior(1.5), **smooth}, 1.5, smooth=True, lossless=True)


def _rough_dielectric_edges(model: Bsdf) -> Iterator[Case]:
    for rough in _edge_roughness(model):
        for eta in EDGE_ETAS:
            yield Case(model, {**_ior(eta), **rough}, eta)
    tints = {"specular_reflectance": BLACK, "specular_transmittance": WHITE}
    yield Case(model, {**_ior(1.5), **_edge_roughness(model)[-1], **tints}, 1.5)


def _plastic(model: Bsdf) -> Iterator[Case]:
    for colour, eta in ((RED, 1.49), (WHITE, 1.5), (RED, 1.0), (RED, 10.0), (BLACK, 1.5)):
        # Without a base it is a mirror. Equal indices count as no boundary at all, which has no slope.
        yield Case(
            model,
            {"diffuse_reflectance": colour, **_ior(eta)},
            eta,
            furnace=2e-4 if colour == WHITE else 0.0,
            smooth=colour == BLACK,
            differentiable=eta != 1.0,
        )
    yield Case(model, {"diffuse_reflectance": RED, **_ior(1.5), "specular_reflectance": (0.2, 0.9, 0.5)}, 1.5)


def _plastic_edges(model: Bsdf) -> Iterator[Case]:
    for eta in EDGE_ETAS:
        for colour in (BLACK, WHITE):
            yield Case(model, {"diffuse_reflectance": colour, **_ior(eta)}, eta)
            yield Case(model, {"diffuse_reflectance": colour, **_ior(eta), "specular_reflectance": BLACK}, eta)


def _rough_plastic(model: Bsdf) -> Iterator[Case]:
    for i, rough in enumerate(_roughness(model)):
        tint = {"specular_reflectance": (0.2, 0.9, 0.5)} if i == 2 else {}
        yield Case(
            model, {"diffuse_reflectance": RED, **_ior(1.49), **rough, **tint}, 1.49, differentiable=_is_wide(rough)
        )
    yield Case(model, {"diffuse_reflectance": WHITE, **_ior(1.5), "alpha": 0.3}, 1.5)
    yield Case(model, {"diffuse_reflectance": RED, **_ior(1.0), "alpha": 0.1}, 1.0, differentiable=False)
    yield Case(model, {"diffuse_reflectance": RED, **_ior(10.0), "alpha": 0.05}, 10.0)
    yield Case(model, {"diffuse_reflectance": BLACK, **_ior(1.5), "alpha": 0.1}, 1.5)
    yield Case(model, {"diffuse_reflectance": RED, **_ior(1.49), "alpha": 0.0}, 1.49)


def _rough_plastic_edges(model: Bsdf) -> Iterator[Case]:
    for rough in _edge_roughness(model):
        for eta in EDGE_ETAS:
            yield Case(model, {"diffuse_reflectance": WHITE, **_ior(eta), **rough}, eta)
    for colour, tint in ((BLACK, BLACK), (WHITE, BLACK), (BLACK, WHITE)):
        values = {"diffuse_reflectance": colour, "specular_reflectance": tint, **_ior(1.5), "alpha": 0.3}
        yield Case(model, values, 1.5)


def _nonmetal(model: Bsdf) -> Iterator[Case]:
    for specular, roughness in ((0.04, 0.5), (1.0, 0.3), (0.0, 0.5), (0.5, 0.1), (0.3, 1.0), (0.5, 0.02)):
        rough = {"roughness": roughness}
        yield Case(model, {"base_color": RED, "specular": specular, **rough}, differentiable=_is_wide(rough))


def _nonmetal_edges(model: Bsdf) -> Iterator[Case]:
    for colour in (BLACK, WHITE):
        for specular in (0.0, 1.0):
            for roughness in (0.0, 0.01, 1.0):
                yield Case(model, {"base_color": colour, "specular": specular, "roughness": roughness})


def _microfacet(model: Bsdf) -> Iterator[Case]:
    for diffuse, specular, roughness, ior in (
        ((0.725, 0.71, 0.68), WHITE, 0.4, 1.85),
        (RED, (0.2, 0.9, 0.5), 0.1, 1.5),
        (BLACK, WHITE, 0.7, 10.0),
        (WHITE, BLACK, 0.3, 1.5),
        (RED, WHITE, 1.0, 1 / 1.5),
        (RED, WHITE, 0.02, 1.85),
    ):
        values = {"diffuse": diffuse, "specular": specular, "roughness": roughness, "ior": ior}
        yield Case(model, values, ior, differentiable=roughness >= 0.1)


def _microfacet_edges(model: Bsdf) -> Iterator[Case]:
    for eta in EDGE_ETAS:
        for roughness in (0.0, 0.01, 1.0):
            yield Case(model, {"diffuse": WHITE, "specular": WHITE, "roughness": roughness, "ior": eta}, eta)
    yield Case(model, {"diffuse": BLACK, "specular": BLACK, "roughness": 0.4, "ior": 1.85}, 1.85)


FEATURES: Values = {
    "metallic": 0.7,
    "spec_tint": 0.8,
    "sheen": 0.9,
    "sheen_tint": 0.6,
    "clearcoat": 0.8,
    "clearcoat_gloss": 0.4,
    "flatness": 0.7,
}


def _principled_base(model: Bsdf, roughness: float = 0.4) -> Values:
    values: Values = {"base_color": RED, "roughness": roughness}
    if getattr(model, "anisotropic", False):
        values["anisotropic"] = 0.6
    if getattr(model, "transmissive", False):
        values["spec_trans"] = 0.7
    return values


def _principled(model: Bsdf) -> Iterator[Case]:
    base = _principled_base(model)
    through = getattr(model, "transmissive", False)
    eta = 1.5  # what specular = 0.5 means
    yield Case(model, {**base, "specular": 0.5}, eta)
    yield Case(model, {**base, "eta": 1.33}, 1.33)
    for roughness in (0.01, 0.1, 1.0):
        values = {**_principled_base(model, roughness), "eta": 1.5}
        yield Case(model, values, 1.5, differentiable=roughness >= 0.1)
    for name in ("metallic", "sheen", "clearcoat", "flatness"):
        yield Case(model, {**base, "eta": 1.5, name: FEATURES[name]}, 1.5)
    yield Case(model, {**base, "eta": 1.5, "metallic": 1.0}, 1.5)
    yield Case(model, {**base, "eta": 1.5, "spec_tint": 0.8}, 1.5)
    yield Case(model, {**base, "eta": 1.5, "sheen": 1.0, "sheen_tint": 1.0}, 1.5)
    yield Case(model, {**base, "eta": 1.5, "clearcoat": 1.0, "clearcoat_gloss": 1.0}, 1.5)
    yield Case(model, {**base, "eta": 1.5, **FEATURES}, 1.5)
    yield Case(model, {"base_color": RED, "roughness": 0.7, "eta": 1.8, **FEATURES, **_extra(model, 1.0)}, 1.8)
    if through:
        yield Case(model, {**base, "eta": 1.5, "spec_trans": 1.0}, 1.5)


def _extra(model: Bsdf, amount: float) -> Values:
    extra: Values = {}
    if getattr(model, "anisotropic", False):
        extra["anisotropic"] = amount
    if getattr(model, "transmissive", False):
        extra["spec_trans"] = amount
    return extra


def _principled_edges(model: Bsdf) -> Iterator[Case]:
    ones, zeros = dict.fromkeys(FEATURES, 1.0), dict.fromkeys(FEATURES, 0.0)
    for roughness in (0.0, 0.01, 1.0):
        for colour in (BLACK, WHITE):
            for features in ({}, ones, zeros, {**ones, "metallic": 0.0}, {**zeros, "metallic": 1.0}):
                for amount in (0.0, 1.0):
                    values = {"base_color": colour, "roughness": roughness, "eta": 1.5, **features}
                    yield Case(model, {**values, **_extra(model, amount)}, 1.5)
    for eta in (1.00001, 10.0):
        yield Case(model, {"base_color": WHITE, "roughness": 0.3, "eta": eta, **FEATURES, **_extra(model, 0.5)}, eta)
    for specular in (0.0, 1.0):
        yield Case(model, {"base_color": WHITE, "roughness": 0.3, "specular": specular, **_extra(model, 0.5)}, 1.0)


def _blend(model: Bsdf) -> Iterator[Case]:
    a, b = (list(cases_of(getattr(model, side))) for side in "ab")
    for i, weight in enumerate((0.5, 0.02, 0.9, 0.0, 1.0)):
        first, second = a[(2 * i) % len(a)], b[(2 * i + 1) % len(b)]
        if first.eta != 1.0:  # both must be of one index where both refract
            second = next((case for case in b if case.eta in (1.0, first.eta)), second)
        yield Case(
            model,
            {"weight": weight, "a": first.values, "b": second.values},
            eta=first.eta if getattr(model, "a").refracts else second.eta,  # noqa: B009
            conserves=first.conserves and second.conserves,
            smooth=(first.smooth or weight == 1.0) and (second.smooth or weight == 0.0),
            differentiable=first.differentiable and second.differentiable,
        )


def _blend_edges(model: Bsdf) -> Iterator[Case]:
    a, b = (list(edges_of(getattr(model, side))) for side in "ab")
    for i in range(0, max(len(a), len(b)), 3):
        for weight in (0.0, 1.0, 0.5):
            first, second = a[i % len(a)], b[i % len(b)]
            yield Case(model, {"weight": weight, "a": first.values, "b": second.values}, first.eta)


def _null(model: Bsdf) -> Iterator[Case]:
    yield Case(model, {}, smooth=True, lossless=True, label="nothing")


def _numbers(model: Bsdf) -> dict[str, Scalar | Color]:
    """Parameters of a model's own that a material without further keys gives it, or has to."""
    specs = {key: spec for key, spec in parameters_of(model).items() if key not in Bsdf.parameters}
    return {
        key: s
        for key, s in specs.items()
        if isinstance(s, Scalar | Color) and s.differentiable and s.default is not None
    }


def _between(spec: Scalar | Color, share: float) -> Any:
    """A value so far from the least to the greatest that a spec accepts."""
    low, high = (0.0 if spec.low is None else spec.low), (1.0 if spec.high is None else spec.high)
    number = low + share * (high - low)
    return (number, 0.5 * (low + number), number) if spec.coloured else number


def _by_specs(model: Bsdf) -> Iterator[Case]:
    """What stands in for a row of :data:`BUILDERS`: a model's defaults, and places in the ranges that it declares."""
    specs = _numbers(model)
    yield Case(model, {k: _between(s, 0.5) if s.default is REQUIRED else s.default for k, s in specs.items()})
    for share in (0.2, 0.7):
        yield Case(model, {key: _between(spec, share) for key, spec in specs.items()})


def _edges_by_specs(model: Bsdf) -> Iterator[Case]:
    """Each parameter at either end of its range, the others half-way; all at one end."""
    specs = _numbers(model)
    middle = {key: _between(spec, 0.5) for key, spec in specs.items()}
    for end in (0.0, 1.0):
        yield Case(model, {key: _between(spec, end) for key, spec in specs.items()}, label=f"all at {end:g}")
        for key, spec in specs.items():
            yield Case(model, {**middle, key: _between(spec, end)})


Builder = Callable[[Bsdf], Iterator[Case]]

#: By a model's name: materials of its range, and materials at its edges. Of others see :func:`_by_specs`: a row can say
#: more, such as that a white one loses nothing.
BUILDERS: dict[str, tuple[Builder, Builder]] = {
    "diffuse": (_diffuse, _diffuse_edges),
    "roughdiffuse": (_rough_diffuse, _rough_diffuse_edges),
    "phong": (_glossy, _glossy_edges),
    "blinn_phong": (_glossy, _glossy_edges),
    "conductor": (_conductor, _conductor_edges),
    "roughconductor": (_rough_conductor, _rough_conductor_edges),
    "dielectric": (_dielectric, _dielectric_edges),
    "thindielectric": (_dielectric, _dielectric_edges),
    "roughdielectric": (_rough_dielectric, _rough_dielectric_edges),
    "plastic": (_plastic, _plastic_edges),
    "roughplastic": (_rough_plastic, _rough_plastic_edges),
    "nonmetal": (_nonmetal, _nonmetal_edges),
    "microfacet": (_microfacet, _microfacet_edges),
    "principled": (_principled, _principled_edges),
    "blend": (_blend, _blend_edges),
    "null": (_null, _null),
}


def cases_of(model: Bsdf) -> list[Case]:
    """Materials over the range of a model."""
    return list(BUILDERS.get(model.name, (_by_specs, _edges_by_specs))[0](model))


def edges_of(model: Bsdf) -> list[Case]:
    """Materials at the ends of the ranges, where numbers break."""
    return list(BUILDERS.get(model.name, (_by_specs, _edges_by_specs))[1](model))


def leaves(values: Parameters) -> list[Tensor]:
    """Every tensor among the values."""
    return [t for value in values.values() for t in (leaves(value) if isinstance(value, dict) else [value])]
