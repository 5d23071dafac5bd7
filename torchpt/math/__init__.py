"""Pure functions on tensors: vectors, frames, warps, MIS, distributions. Nothing here knows of scenes."""
