"""Ranks (several processes, as torch.distributed calls them) that render one picture together.

================  ==========================================================
``group.py``      the ranks of a process group, and their communication
``partition.py``  partition of pixels and items among ranks
``launch.py``     ranks that torchrun started, for the command line
================  ==========================================================

A render by one process imports nothing of torch.distributed.
"""

from torchpt.ranks.group import Group, together
from torchpt.ranks.partition import blocks, dealt, share

__all__ = ["Group", "blocks", "dealt", "share", "together"]
