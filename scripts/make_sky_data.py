"""Write the numbers of the sky and the sun of Hosek and Wilkie that ``torchpt`` ships.

    python scripts/make_sky_data.py          # needs the extra `bench`, whose Mitsuba has the authors' data sets

Mitsuba 3 has the data sets as tensors: for the sky fits in linear sRGB, for the sun its radiance in 11 wavelengths and how it
falls off to the limb. It also has the sun in linear sRGB, six times as large; the matrix from wavelengths to linear sRGB is
found from that. Licence of the numbers: ``torchpt/physics/lights/hosek_wilkie.LICENSE``.
"""

from __future__ import annotations

import struct
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

TARGET = Path(__file__).parents[1] / "torchpt" / "physics" / "lights" / "hosek_wilkie.npz"
TYPES = {10: "<f4", 11: "<f8"}


def fields(file: Path) -> dict[str, NDArray[np.float64]]:
    """Return the tensors of a tensor file of Mitsuba by name."""
    data = file.read_bytes()
    (count,), at, found = struct.unpack_from("<I", data, 14), 18, {}
    for _ in range(count):
        (length,) = struct.unpack_from("<H", data, at)
        name = data[at + 2 : at + 2 + length].decode()
        dimensions, kind, offset = struct.unpack_from("<HBQ", data, at + 2 + length)
        at += 2 + length + 11
        shape = struct.unpack_from(f"<{dimensions}Q", data, at)
        at += 8 * dimensions
        if kind in TYPES:
            found[name] = (
                np.frombuffer(data, TYPES[kind], int(np.prod(shape)), offset).reshape(shape).astype(np.float64)
            )
    return found


def main() -> None:
    """Write the file."""
    spec = find_spec("mitsuba")
    assert spec is not None and spec.origin is not None, "Mitsuba is not installed (the extra `bench`)"
    given = fields(Path(spec.origin).parent / "data" / "sunsky" / "sunsky_datasets.bin")
    sun, limb = given["sun_rad_spec"], given["sun_ld_spec"]
    spectral = np.einsum("tskw,wj->tskjw", np.moveaxis(sun, 2, 3), limb).reshape(-1, 11)
    rgb = np.moveaxis(given["sun_rad_rgb"], 2, -1).reshape(-1, 3)
    to_rgb = np.linalg.lstsq(spectral, rgb, rcond=None)[0]
    assert np.abs(spectral @ to_rgb - rgb).max() < 1e-12 * np.abs(rgb).max()
    arrays = {
        "sky_parameters": given["sky_params_rgb"],
        "sky_radiance": given["sky_rad_rgb"],
        "sun_radiance": sun,
        "sun_limb": limb,
        "sun_to_rgb": to_rgb,
    }
    with TARGET.open("wb") as file:
        np.savez_compressed(file, **{name: array.astype(np.float32) for name, array in arrays.items()})
    print(f"{TARGET}: {TARGET.stat().st_size} bytes")


if __name__ == "__main__":
    main()
