"""A material that is a small network, trained in the path until its pictures are those of lacquered copper.

    python scripts/examples/06_neural_bsdf.py --out FOLDER

The model is `f cos = g pdf`. `pdf` is the density that directions are drawn with: by the cosine, or as GGX facets mirror;
how often which, and how rough the facets are, are trained too. `g (3,)` is the network, between 0 and 1. So a sample's
weight is `g`, which no noise can blow up, and the integral of `f cos` is at most 1 whatever the weights are: light may
go round between such surfaces for ever and dies out. What it costs: the model is not reciprocal, and can only be as bright
as `pdf` lets it be.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from example_tools import arguments, grid
from torch import Tensor, nn

import torchpt
from torchpt.math.sampling import cosine_hemisphere
from torchpt.physics.bsdfs.records import BsdfSample

LACQUER = {"type": "principled", "base_color": [0.75, 0.3, 0.15], "metallic": 0.6, "roughness": 0.45, "clearcoat": 0.5}
#: Where the lamp stands in the pictures to match; and where in the one that is held out.
LAMPS = ([-1.5, 2.0, 2.0], [2.2, 1.0, 0.5], [0.3, 3.0, -1.0], [-2.0, 0.6, 0.6])
ELSEWHERE = [1.2, 1.8, 2.2]


class Learned(torchpt.Bsdf):
    """``f cos = g pdf``; directions are local, ``+z`` is the normal."""

    name = "learned"
    parameters = {}  # noqa: RUF012
    lobed = True
    reciprocal = False

    def __init__(self) -> None:
        self.net = nn.Sequential(
            nn.Linear(4, 24), nn.SiLU(), nn.Linear(24, 24), nn.SiLU(), nn.Linear(24, 3), nn.Sigmoid()
        )
        self.drawn = nn.ParameterDict({"share": torch.tensor(-1.0), "roughness": torch.tensor(-0.5)})

    def eval_pdf(self, parameters: dict[str, Tensor], wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
        """``f cos (3, N)`` and the density ``(N,)``."""
        h = nn.functional.normalize(wo + wi, dim=0)
        o_h = (wo * h).sum(0).clamp_min(1e-4)
        square = self.drawn["roughness"].sigmoid() ** 4
        facets = square / (math.pi * (1 + h[2] ** 2 * (square - 1)) ** 2)
        share = self.drawn["share"].sigmoid()
        pdf = ((1 - share) * wi[2] / math.pi + share * facets * h[2] / (4 * o_h)) * ((wi[2] > 0) & (wo[2] > 0))
        g = self.net(torch.stack((h[2], o_h, wo[2], wi[2]), 1)).T
        return g * pdf, pdf.detach()

    def sample(self, parameters: dict[str, Tensor], wo: Tensor, lobe: Tensor | None, u: Tensor) -> BsdfSample:
        """One of both ways; directions are fixed in the derivative, and what they weigh follows the weights."""
        assert lobe is not None
        square = self.drawn["roughness"].detach().sigmoid() ** 4
        cosine = ((1 - u[0]) / (1 + (square - 1) * u[0])).sqrt()
        sine, phi = (1 - cosine**2).clamp_min(0).sqrt(), 2 * math.pi * u[1]
        h = torch.stack((sine * phi.cos(), sine * phi.sin(), cosine))
        mirrored = 2 * (wo * h).sum(0) * h - wo
        wi = torch.where(lobe < self.drawn["share"].detach().sigmoid(), mirrored, cosine_hemisphere(u)).detach()
        value, pdf = self.eval_pdf(parameters, wo, wi)
        return BsdfSample(wi, pdf, torch.where(pdf > 0, value / torch.where(pdf > 0, pdf, 1), 0))


def lit(material: dict, size: int, **models: torchpt.Bsdf) -> torchpt.Scene:
    """Return a ball over a floor of the same material."""
    flat = [{"scale": 6}, {"rotate": {"axis": [1, 0, 0], "angle": -90}}, {"translate": [0, -1, 0]}]
    return torchpt.load(
        {
            "camera": {"origin": [0, 1.2, 4.5], "target": [0, -0.2, 0], "fov": 36},
            "film": {"width": size, "height": size, "filter": "box"},
            "integrator": {"type": "path", "max_depth": 3},
            "materials": {"own": material},
            "shapes": {
                "ball": {"type": "sphere", "material": "own"},
                "floor": {"type": "rectangle", "material": "own", "transform": flat},
                "lamp": {"type": "sphere", "radius": 0.4, "emission": 15},
            },
            "lights": {"sky": {"type": "constant", "radiance": 0.3}},
        },
        bsdfs=models,
    )


def main(argv: Sequence[str] | None = None) -> tuple[float, float]:
    """Train it; the error (relative rms) under a lamp that it was not trained with, at the start and at the end."""
    args = arguments(__doc__, steps=160, size=32, argv=argv)
    torch.manual_seed(args.seed)
    learned = Learned()
    true, own = lit(LACQUER, args.size), lit({"type": "learned"}, args.size, learned=learned)
    base = true.params["shapes.lamp.to_world"]

    def under(place: list[float]) -> dict[str, Tensor]:
        return {"shapes.lamp.to_world": torch.cat((base[:, :3], torch.tensor([[*place, 1.0]]).T), 1)}

    targets = [torchpt.render(true, params=under(place), spp=256, seed=args.seed + 1000) for place in LAMPS]
    held_out = torchpt.render(true, params=under(ELSEWHERE), spp=256, seed=args.seed + 1000)

    @torch.no_grad()
    def test() -> tuple[Tensor, float]:
        picture = torchpt.render(own, params=under(ELSEWHERE), spp=128)
        return picture, float(((picture - held_out).square().mean() / held_out.square().mean()).sqrt())

    optimizer = torch.optim.Adam([*learned.net.parameters(), *learned.drawn.parameters()], lr=0.02)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, args.steps, 0.0005)
    at_start, before = test()
    for step in range(args.steps):
        k = step % len(LAMPS)
        optimizer.zero_grad()
        picture = torchpt.render(own, params=under(LAMPS[k]), spp=8, seed=args.seed + step)
        ((picture - targets[k]) / (targets[k] + 0.1)).square().mean().backward()
        optimizer.step()
        schedule.step()

    at_end, after = test()
    grid(args.out / "06_neural_bsdf.png", [held_out, at_start, at_end])
    share, rough = (float(learned.drawn[key].detach().sigmoid()) for key in ("share", "roughness"))
    print(f"error under a lamp not trained with: {100 * before:.1f} % -> {100 * after:.1f} %")
    print(f"directions drawn by facets: {100 * share:.0f} %, of roughness {rough:.2f}")
    return before, after


if __name__ == "__main__":
    main()
