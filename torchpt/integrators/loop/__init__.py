"""Waves on a CPU as compiled loops: a thread takes a chunk of lanes through all of its path.

The stages are the same tensor functions that run eagerly; :mod:`torchpt.lanes` makes kernels of them. Between two kernels of
a chunk there is neither an operator of torch nor a barrier between threads.
"""
