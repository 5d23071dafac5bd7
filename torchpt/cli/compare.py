"""`torchpt compare`: measure the error of a picture against a reference, and write an error map."""

from __future__ import annotations

import json
import math
import os
import re
import sys
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from torchpt.cli import gc_pause
from torchpt.cli.arguments import UsageError
from torchpt.cli.interrupt import Interrupt
from torchpt.cli.render import plain
from torchpt.cli.streams import flushed_stdout
from torchpt.core.errors import AssetError, OutputError, SceneError

if TYPE_CHECKING:
    from torch import Tensor

    from torchpt.images.comparison import Comparison, DisplayTransform

__all__ = ["HELP", "run"]

HELP = """\
torchpt compare TEST REFERENCE [--json] [map=FILE.png|FILE.exr] [key=value ...]

  Every measure of the error of TEST against REFERENCE, two pictures of one size and as many channels.
  torchpt compare test.exr reference.exr map=error.png

  map=       write where the error lies: .png in colours, .exr as numbers
  metric=    what the map shows: relmse mse smape ssim flip                                             relmse
  range=     what the brightest colour of a .png stands for         1 for smape ssim flip, else 99 % are below it
  layer=     of .exr files: albedo, normal, ...                                                    the picture
  exposure= tonemap= gamma=   how a screen shows them, for psnr and ssim; values as of film.*           0 none srgb
  --json     print one JSON object in place of the table; null where there is no number, and `reasons` says why
  --         what follows are names of files, whatever they look like

flip needs the extra `compare`. Exit codes: 0 compared, however far apart; 2 bad input.
"""
_KEYS = ("map", "metric", "range", "layer", "exposure", "tonemap", "gamma")
# KEY=VALUE of a key above; the value may hold line breaks.
_KEY = re.compile(rf"({'|'.join(_KEYS)})=(.*)\Z", re.DOTALL)
_MAP_ENDINGS = (".exr", ".png")
_DISPLAY_KEYS = ("exposure", "tonemap", "gamma")
#: Columns of text that does not go to a terminal.
_FILE_WIDTH = 120
#: Metrics whose values are at most 1.
_UP_TO_ONE = ("smape", "ssim", "flip")


@dataclass
class CompareOptions:
    """The parsed arguments of ``torchpt compare``.

    Attributes:
        pictures: paths of the picture and of its reference, as written.
        text_of_key: values by key, as written.
        json: print JSON.
    """

    pictures: list[str] = field(default_factory=list)
    text_of_key: dict[str, str] = field(default_factory=dict)
    json: bool = False

    @classmethod
    def read(cls, words: list[str]) -> CompareOptions:
        """Parse the words after ``torchpt compare``; a file name may contain any characters.

        Raises:
            UsageError: an unknown option or key, a key given twice or without a value, ``metric=`` or ``range=`` without
                ``map=``, or not exactly two pictures.
        """
        options = cls()
        end = words.index("--") if "--" in words else len(words)
        for word in words[:end]:
            if word == "--json":
                options.json = True
            elif word.startswith("-"):
                raise UsageError(f"{word}: unknown option; known: --json, --help, -- (before names of files)")
            elif match := _KEY.match(word):
                key, value = match.groups()
                if key in options.text_of_key:
                    raise UsageError(f"{key}: given twice, as {options.text_of_key[key]!r} and {value!r}")
                if not value:
                    raise UsageError(f"{key}: expected a value, got nothing")
                options.text_of_key[key] = value
            elif re.match(r"[\w.]+=", word) and not os.path.exists(word):
                raise UsageError(f"{word}: unknown key, and no file of this name; known: {', '.join(_KEYS)}")
            else:
                options.pictures.append(word)
        options.pictures += words[end + 1 :]
        options._check()
        return options

    def _check(self) -> None:
        if len(self.pictures) != 2:
            names = f": {', '.join(self.pictures)}" if self.pictures else ""
            raise UsageError(f"expected two pictures, torchpt compare TEST REFERENCE, got {len(self.pictures)}{names}")
        for key in ("metric", "range"):
            if key in self.text_of_key and "map" not in self.text_of_key:
                raise UsageError(f"{key}: says what the error map shows, and there is none; add map=FILE.png")


@dataclass(frozen=True)
class _MapRequest:
    """The error map to write: file, metric, and the error that gets the brightest colour (None: see ``_top_of_range``)."""

    file: str
    metric: str
    top: float | None


def run(words: list[str], interrupt: Interrupt) -> int:
    """Compare two pictures, print the metrics, write the error map and return the exit code.

    Raises:
        TorchptError: bad input.
    """
    options = CompareOptions.read(words)
    from torchpt.images.comparison import compare as measure

    gc_pause.resume()  # the imports are done: collect garbage again
    screen, map_request = _display_transform(options.text_of_key), _map_request(options)
    layer = options.text_of_key.get("layer")
    (name, first), (_, second) = (_read_layer(path, layer) for path in options.pictures)
    _check_same_size(options.pictures, first, second)
    height, width, channels = first.shape
    colours = _is_colour(name, channels)
    if not colours:
        _refuse_colour_keys(options, name)
    (image, alpha), (reference, reference_alpha) = (
        _split_alpha(picture, colours=colours) for picture in (first, second)
    )
    found = measure(image, reference, screen, colours=colours)
    facts: dict[str, Any] = {"test": options.pictures[0], "reference": options.pictures[1], "layer": name}
    facts |= {"width": width, "height": height, "channels": channels, "metrics": found.metrics}
    facts |= {"reasons": found.reasons, "mean": dict(zip(("test", "reference"), found.means, strict=True))}
    facts["mean_ratio"] = found.ratio
    facts["nonfinite_pixels"] = dict(zip(("test", "reference"), found.nonfinite, strict=True))
    if colours:
        facts["display"] = vars(screen)
    if alpha is not None and reference_alpha is not None:
        facts["largest_alpha_difference"] = float((alpha.double() - reference_alpha.double()).abs().max())
    if map_request is not None:
        facts["map"] = _write_map(map_request, image, reference, screen)
    with flushed_stdout():
        if options.json:
            print(json.dumps(plain(facts), allow_nan=False))
        else:
            _print_tables(facts, found)
    return 0


def _display_transform(text_of_key: dict[str, str]) -> DisplayTransform:
    """Parse ``exposure=``, ``tonemap=`` and ``gamma=``, which take the same values as ``film.*``.

    Raises:
        SceneError: an invalid value.
    """
    from torchpt.images.comparison import DisplayTransform
    from torchpt.scene.settings import Film
    from torchpt.spec.reading import Refused

    values: dict[str, Any] = {}
    for key in _DISPLAY_KEYS:
        if key in text_of_key:
            text = text_of_key[key]
            number = _float_or_nan(text)
            try:
                values[key] = Film.parameters[key].read(text if math.isnan(number) else number)
            except Refused as refused:
                raise SceneError(key, text, refused.expected) from None
    return DisplayTransform(**values)


def _float_or_nan(text: str) -> float:
    """Return a number, or NaN for text that is none."""
    try:
        return float(text)
    except ValueError:
        return math.nan


def _map_request(options: CompareOptions) -> _MapRequest | None:
    """Return the error map to write, checked before the pictures are read; None without ``map=``.

    Raises:
        TorchptError: a file that cannot be written, an unknown metric, or an invalid range.
    """
    from torchpt.images import check_writable
    from torchpt.images.metrics import MAPS

    text_of_key = options.text_of_key
    if "map" not in text_of_key:
        return None
    metric = text_of_key.get("metric", "relmse")
    if metric not in MAPS:
        raise SceneError("metric", metric, f"one of {', '.join(MAPS)}")
    map_path = check_writable(text_of_key["map"], _MAP_ENDINGS)
    if str(map_path) in map(os.path.realpath, options.pictures):
        raise OutputError(text_of_key["map"], "is one of the pictures that are compared; give map= another name")
    if "range" not in text_of_key:
        return _MapRequest(text_of_key["map"], metric, top=None)
    if map_path.suffix.lower() == ".exr":
        raise UsageError("range: an .exr map holds the numbers themselves; only .png has a range")
    top = _float_or_nan(text_of_key["range"])
    if not 0.0 < top < math.inf:
        raise SceneError("range", text_of_key["range"], "a number above 0")
    return _MapRequest(text_of_key["map"], metric, top=top)


def _read_layer(path: str, layer: str | None) -> tuple[str, Tensor]:
    """Read a layer of a file: return its name and values ``(H, W, C)``. Default: the picture, or the only layer.

    Raises:
        AssetError: a file that cannot be read, or that has no such layer.
    """
    import torch

    from torchpt.images import read_layers

    layers = read_layers(path)
    if layer is None and len(layers) == 1:
        return next(iter(layers.items()))
    wanted = layer or "image"
    if wanted not in layers:
        what = f"has no layer {wanted!r}" if layer else "has no picture among its layers; choose one with layer="
        raise AssetError(path, f"{what}; it has {', '.join(layers)}")
    if layer is None and "alpha" in layers and layers[wanted].shape[2] == 3:
        return wanted, torch.cat((layers[wanted], layers["alpha"]), 2)
    return wanted, layers[wanted]


def _check_same_size(paths: list[str], first: Tensor, second: Tensor) -> None:
    """Raise AssetError unless two pictures have the same size and number of channels."""
    sizes = [f"{picture.shape[1]} x {picture.shape[0]}" for picture in (first, second)]
    if sizes[0] != sizes[1]:
        raise AssetError(paths[0], f"is {sizes[0]} pixels, and {paths[1]} is {sizes[1]}: sizes must agree")
    counts = [f"{picture.shape[2]} channel{'s' * (picture.shape[2] > 1)}" for picture in (first, second)]
    if counts[0] != counts[1]:
        raise AssetError(paths[0], f"has {counts[0]}, and {paths[1]} has {counts[1]}: channels must agree")


def _is_colour(layer: str, channels: int) -> bool:
    """Return True if a layer holds colours (channels R G B [A], or grey), and not normals, distances or other numbers."""
    from torchpt.images.layers import channel_names

    if layer == "image":
        return channels <= 4
    return [name.rpartition(".")[2] for name in channel_names(layer, channels)][:3] == ["R", "G", "B"]


def _refuse_colour_keys(options: CompareOptions, layer: str) -> None:
    from torchpt.images.comparison import COLOUR_METRICS

    for key in _DISPLAY_KEYS:
        if key in options.text_of_key:
            raise UsageError(f"{key}: the layer {layer} holds no colours, so it is not shown on a screen")
    if options.text_of_key.get("metric") in COLOUR_METRICS:
        raise UsageError(f"metric: the layer {layer} holds no colours; expected relmse, mse or smape")


def _split_alpha(picture: Tensor, *, colours: bool) -> tuple[Tensor, Tensor | None]:
    """Split a picture into its colours and its alpha channel; None without, and for layers that hold no ``colours``."""
    if colours and picture.shape[2] in (2, 4):
        return picture[..., :-1], picture[..., -1]
    return picture, None


def _write_map(map_request: _MapRequest, image: Tensor, reference: Tensor, screen: DisplayTransform) -> dict[str, Any]:
    """Write the error map and return its facts: file, metric, largest error, range of the colours.

    Raises:
        OutputError: a metric that has no map for these pictures, or a file that cannot be written.
    """
    import torch

    from torchpt.images import write_image
    from torchpt.images.comparison import comparison_map
    from torchpt.images.false_colour import false_colour

    try:
        errors = comparison_map(map_request.metric, image, reference, screen)
    except (ImportError, ValueError) as problem:
        raise OutputError(map_request.file, f"there is no such map: {problem}") from None
    finite = errors[torch.isfinite(errors)]
    largest = float(finite.max()) if finite.numel() else math.nan
    facts = {"file": map_request.file, "metric": map_request.metric, "largest": largest}
    if map_request.file.lower().endswith(".exr"):
        write_image(map_request.file, errors[..., None])
        return facts
    top = map_request.top or (1.0 if map_request.metric in _UP_TO_ONE else _top_of_range(finite))
    write_image(map_request.file, false_colour(errors, top), gamma=1.0)
    return facts | {"range": [0.0, top]}


def _top_of_range(values: Tensor) -> float:
    """Return the 99th percentile of the values; if it is 0 their maximum, and 1 if that is 0 too."""
    if not values.numel():
        return 1.0
    ordered = values.sort().values
    return float(ordered[math.ceil(0.99 * len(ordered)) - 1]) or float(ordered[-1]) or 1.0


def _print_tables(facts: dict[str, Any], found: Comparison) -> None:
    """Print a table of the metrics, a table of the means, and notes about them."""
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    class PipeConsole(Console):
        def on_broken_pipe(self) -> None:  # rich's own version exits the process
            raise BrokenPipeError

    console = PipeConsole(highlight=False, width=None if sys.stdout.isatty() else _FILE_WIDTH)

    def print_line(text: str) -> None:
        code = console.encoding  # a file name may contain characters that the encoding lacks
        console.print(Text(text.encode(code, "backslashreplace").decode(code)), soft_wrap=True)

    def print_table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> None:
        rich_table = Table(box=SIMPLE_HEAD, show_edge=False, pad_edge=False)
        for index, title in enumerate(head):
            rich_table.add_column(title, justify="right" if index > 0 else "left")  # names, then numbers
        for row in rows:
            rich_table.add_row(*map(Text, row))
        console.print()
        console.print(rich_table)

    print_line(f"test       {facts['test']}\nreference  {facts['reference']}")
    print_line(
        f"           {facts['layer']}, {facts['width']} x {facts['height']} pixels, channels: {facts['channels']}"
    )
    print_table(("measure", "value"), [(name, _format_value(value)) for name, value in found.metrics.items()])
    print_table(("", "test", "reference", "ratio"), _mean_rows(facts, found))
    print_line("")
    for reason in dict.fromkeys(found.reasons.values()):
        print_line(f"{', '.join(name for name in found.reasons if found.reasons[name] == reason)}: {reason}")
    if display := facts.get("display"):
        print_line(
            "psnr, ssim: of what a screen shows; "
            + ", ".join(f"{key} {_format_value(value)}" for key, value in display.items())
        )
    if "largest_alpha_difference" in facts:
        print_line(
            f"alpha is in no measure; its largest difference is {_format_value(facts['largest_alpha_difference'])}"
        )
    if map_facts := facts.get("map"):
        shows = (
            f"; black 0, brightest {_format_value(map_facts['range'][1])} and more, green not finite"
            if "range" in map_facts
            else ""
        )
        print_line(
            f"map: {map_facts['metric']}, largest {_format_value(map_facts['largest'])}{shows}, in {map_facts['file']}"
        )


def _mean_rows(facts: dict[str, Any], found: Comparison) -> list[tuple[str, ...]]:
    """Return table rows: the mean over all channels, the mean of each, and the number of pixels that are not finite."""
    test_means, reference_means = found.means
    names = (
        ("red", "green", "blue")
        if len(test_means) == 3 and "display" in facts
        else [str(k) for k in range(len(test_means))]
    )
    rows = [
        (f"mean, {name}", _format_value(a), _format_value(b), _format_value(a / b if b else math.nan))
        for name, a, b in zip(names, test_means, reference_means, strict=True)
    ]
    overall = (sum(test_means) / len(test_means), sum(reference_means) / len(reference_means))
    rows = [("mean", *map(_format_value, overall), _format_value(found.ratio)), *(rows if len(test_means) > 1 else [])]
    return [*rows, ("pixels not finite", *(f"{count:,}" for count in found.nonfinite), "")]


def _format_value(value: float | str) -> str:
    if isinstance(value, str):
        return value
    if math.isinf(value):
        return "infinite"
    return "none" if math.isnan(value) else f"{value:.6g}"
