"""What an integrator is: its settings, what it plans of a render, and what it makes of camera rays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import torch

from torchpt.integrators.roulette import DEEP, DEEP_CAP
from torchpt.integrators.stages import STRATEGIES, Plan
from torchpt.lights import WAYS
from torchpt.spec import Choice, Flag, Scalar, Spec, Valued, parameters_of

if TYPE_CHECKING:
    from typing import Self

    from torch import Tensor

    from torchpt.accel import Accel
    from torchpt.integrators.first_surface import FirstSurface
    from torchpt.integrators.stage_runner import Stages
    from torchpt.integrators.tally import Tally
    from torchpt.records import PathState, World
    from torchpt.samplers import Points

__all__ = ["LIGHT_CHOICE", "SAMPLES", "STRATEGY", "Integrator", "Limits"]

#: Parameters that several kinds have.
STRATEGY: dict[str, Spec] = {
    "strategy": Choice(
        "mis",
        names=STRATEGIES,
        doc="how light is found: BSDF and lights, one alone, or evenly",
    ),
}
LIGHT_CHOICE: dict[str, Spec] = {
    "light_choice": Choice(
        "auto",
        names=WAYS,
        doc="which of many lights is sampled",
    ),
}
SAMPLES: dict[str, Spec] = {
    "clamp": Scalar(None, above=0.0, words="null or a number > 0", doc="largest component of a sample; biased"),
    "strict": Flag(False, doc="whether a sample that is not finite is an error"),
}


@dataclass(frozen=True)
class Limits:
    """Where paths end."""

    max_depth: int  # -1: only roulette ends them
    rr_depth: int  # roulette from this vertex on

    def roulette(self, depth: int) -> float:
        """The most that roulette lets paths survive with at a vertex; 0 where it does not play."""
        if depth < self.rr_depth:
            return 0.0
        return DEEP_CAP if self.max_depth < 0 and depth > DEEP else 1.0


class Integrator(Valued):
    """A kind of integrator; an instance holds the values of its parameters.

    Attributes:
        name: its ``type`` in a scene file.
        light: whether it estimates radiance; else the picture shows layers, and :meth:`radiance` is not asked for.
        layers: layers that are shown where ``film.aovs`` names none.
        lit: whether it sees the scene's lights; else its world has none.
        looped: whether the compiled loop of CPUs can run it; else it runs as tensor operations.
        strategy, rr_prob, light_choice, clamp, strict: as for ``path``, where the kind has no such parameter.
    """

    name: ClassVar[str] = ""
    light: ClassVar[bool] = True
    layers: ClassVar[tuple[str, ...]] = ()
    lit: ClassVar[bool] = True
    looped: ClassVar[bool] = False

    strategy: str = "mis"
    rr_prob: float | None = None
    light_choice: str = "auto"
    clamp: float | None = None
    strict: bool = False

    @property
    def limits(self) -> Limits:
        """Where paths end."""
        return Limits(2, 3)

    def plan(self, sampler: Points, dtype: torch.dtype, tape: bool = False, attached: bool = False) -> Plan:
        """What it asks of the stages."""
        return Plan(sampler, self.strategy, self.rr_prob, dtype, tape, attached)

    def counted_in(self, unit: float) -> Self:
        """The same with its lengths in a unit that is so long in the scene's: the lanes'."""
        specs = parameters_of(type(self))
        lengths = {key: value / unit for key, value in self.values.items() if specs[key].length and value is not None}
        return self.but(**lengths) if lengths and unit != 1.0 else self

    def first(self, world: World) -> FirstSurface | None:
        """What happens at first surfaces, made once a scene and differentiable in its world; None where paths go on."""
        return None

    def radiance(self, stages: Stages, accel: Accel, state: PathState, first: Any, tally: Tally) -> Tensor:
        """What camera rays bring.

        Args:
            stages: bound to the scene.
            accel: the search.
            state: camera rays, ``state.radiance`` zero; N lanes.
            first: of :meth:`first`.
            tally: counts what it takes.

        Returns:
            Radiance ``(3, N)``.
        """
        raise NotImplementedError
