"""Tensors in one block of memory, and when they are read as one."""

from __future__ import annotations

import pickle

import numpy as np
import torch

from torchpt.core.memory_block import MemoryBlock, common_block, with_own_memory


def filled() -> list[torch.Tensor]:
    block = MemoryBlock(18)
    return [block.add(np.full((2, 3), value, np.float32)) for value in (1.0, 2.0, 3.0)]


def test_tensors_of_a_block_are_read_as_one():
    tensors = filled()
    joined = common_block(tensors[1:])
    assert joined is not None and joined.data_ptr() == tensors[0].data_ptr()
    assert joined.tolist() == [1.0] * 6 + [2.0] * 6 + [3.0] * 6


def test_tensors_of_a_block_count_their_changes_alone():
    one, other, _ = filled()
    before, before_other = one._version, other._version
    one.mul_(2.0)
    assert other._version == before_other and one._version > before and other[0, 0] == 2.0


def test_no_block_where_derivatives_or_other_memory_are_asked_for():
    one, other, _ = filled()
    assert common_block([one, other.clone()]) is None and common_block([]) is None
    assert torch.func.grad(lambda x: x.sum() * (common_block([x]) is None))(one).tolist() == [[1.0] * 3] * 2
    one.requires_grad_()
    assert common_block([one, other]) is None
    with torch.no_grad():
        assert common_block([one, other]) is not None


def test_own_memory_is_all_that_pickle_writes():
    one = filled()[0].requires_grad_()
    own = with_own_memory(one)
    assert own.equal(one) and own.requires_grad and own.is_leaf and own.untyped_storage().nbytes() == 24
    assert with_own_memory(own) is own
    assert len(pickle.dumps(own)) < len(pickle.dumps(one))
