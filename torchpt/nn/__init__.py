"""``torch.nn`` modules that render, ``torchpt.nn.Renderer``, and parametrizations of what they optimize.

=======================  ===========================================================
``renderer.py``          a scene with chosen parameters as ``nn.Parameter``
``optimizers.py``        Adam with one scale for all numbers of a tensor
``parametrizations.py``  maps unconstrained numbers to the ranges of parameters
``poses.py``             poses from axis and angle, quaternions, or two points
=======================  ===========================================================

May import: ``rendering``, ``scene`` and what lies below.
"""

from __future__ import annotations

from torchpt.nn.optimizers import AdamUniform
from torchpt.nn.parametrizations import AxisAnglePose, LargeSteps, LookAtPose, Parametrization, QuaternionPose
from torchpt.nn.poses import axis_angle_pose, look_at_pose, quaternion_pose
from torchpt.nn.renderer import Renderer

__all__ = [
    "AdamUniform",
    "AxisAnglePose",
    "LargeSteps",
    "LookAtPose",
    "Parametrization",
    "QuaternionPose",
    "Renderer",
    "axis_angle_pose",
    "look_at_pose",
    "quaternion_pose",
]
