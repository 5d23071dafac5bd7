"""Several processes, on one machine or on many, that render one picture together: *ranks*, as torch.distributed calls them.

==============  ==========================================================
``group.py``    the ranks of one process group, and what they say
``dealing.py``  who takes which pixels, or which items of a list
``launch.py``   the ranks that torchrun started, for the command line
==============  ==========================================================

One process never comes here, and imports nothing of torch.distributed.
"""

from torchpt.ranks.group import Group, together
from torchpt.ranks.partition import blocks, dealt, share

__all__ = ["Group", "blocks", "dealt", "share", "together"]
