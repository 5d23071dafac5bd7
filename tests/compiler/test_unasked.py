"""Kernels that are compiled ahead and never needed are not traced again by later processes."""

import os
import subprocess
import sys

import pytest

PROGRAM = """
import torchpt
from torchpt.engines.kernels import programs

traced = []
trace_stage = programs.trace_stage
programs.trace_stage = lambda *given: traced.append(1) or trace_stage(*given)
ball = lambda y, kind: {"type": "sphere", "center": [0, y, 0], "material": {"type": kind}}
scene = torchpt.load({
    "camera": {"origin": [0, 0, 4], "target": [0, 0, 0], "fov": 20},
    "film": {"width": 8, "height": 8},
    "shapes": {"seen": ball(0, "diffuse"), "behind": ball(90, "conductor")},
    "lights": {"lamp": {"type": "point", "position": [0, 2, 4], "intensity": 9}},
})
for _ in range(2):
    torchpt.render(scene, spp=1, integrator={"type": "path", "max_depth": 2}, threads=2)
print(len(traced))
"""


@pytest.mark.slow
@pytest.mark.skipif((os.cpu_count() or 1) < 2, reason="one CPU compiles nothing ahead")
def test_what_nothing_asked_for_is_not_traced_again(tmp_path):
    environment = {**os.environ, "TORCHPT_CACHE": str(tmp_path), "OMP_NUM_THREADS": "2"}
    os.chmod(tmp_path, 0o700)
    counts = []
    for _ in range(3):
        done = subprocess.run(
            [sys.executable, "-c", PROGRAM], env=environment, capture_output=True, text=True, check=True
        )
        counts.append(int(done.stdout))
    assert counts[0] > 2 and counts[1:] == [0, 0]
    assert len([name for name in os.listdir(tmp_path) if name.endswith(".unasked")]) >= 1
