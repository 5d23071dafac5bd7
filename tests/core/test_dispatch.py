"""Functions that engines may take over."""

from __future__ import annotations

import torch

from torchpt.core.dispatch import dispatched


def test_the_first_implementation_that_takes_the_arguments_is_called() -> None:
    @dispatched
    def double(x: int) -> str:
        """Return what twice a number is."""
        return f"plain {2 * x}"

    assert double(3) == "plain 6" and double.__doc__ == "Return what twice a number is."

    def even(x: int) -> str | object:
        return f"even {2 * x}" if x % 2 == 0 else NotImplemented

    double.register(even)
    double.register(even)
    assert (double(3), double(4)) == ("plain 6", "even 8")
    double.register(lambda x: f"all {2 * x}")
    assert double(4) == "all 8"


def test_the_lane_compiler_turns_bits_around_as_tensors_do() -> None:
    from torchpt.compiler.function import compile_lanewise
    from torchpt.engines.kernels import programs  # noqa: F401  (registers)
    from torchpt.physics.samplers.bits import reverse_bits

    numbers = torch.randint(-(2**31), 2**31, (1003,), generator=torch.Generator().manual_seed(1)).int()
    (turned,) = compile_lanewise(lambda x: [reverse_bits(x)], [numbers])(numbers)
    expected = [int(f"{n & 0xFFFFFFFF:032b}"[::-1], 2) for n in numbers.tolist()]
    assert [n & 0xFFFFFFFF for n in turned.tolist()] == expected
    assert [n & 0xFFFFFFFF for n in reverse_bits(numbers).tolist()] == expected
