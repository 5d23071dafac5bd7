"""Parse overrides of scene keys with Hydra's override parser. Scenes themselves never enter Hydra or OmegaConf.

Examples: ``camera.fov=20``, ``+shapes.ball='{type: sphere}'``, ``~lights.sky``. Values ``20,40``, ``choice(a,b)`` and
``range(1,4)`` sweep. :mod:`torchpt.scene.formats.overrides` applies the overrides to a scene.
"""

from __future__ import annotations

import re
from itertools import islice
from typing import Any

from torchpt.cli.arguments import UsageError

__all__ = ["MAX_VALUES", "parse_failure", "read_value", "read_word"]

#: Largest number of values that one override may sweep over.
MAX_VALUES = 10_000
# Sign, key, and the value after `=` where there is one.
_OVERRIDE = re.compile(r"(\+\+|\+|~|)([^=]*)(?:=(.*))?\Z", re.DOTALL)


def read_word(word: str) -> tuple[str, list[Any], bool]:
    """Return the key of an override with its sign (``+``, ``++``, ``~``), its values, and whether it is a sweep.

    Raises:
        UsageError: a word that Hydra's grammar does not accept.
    """
    match = _OVERRIDE.match(word)
    assert match is not None
    sign, key, text = match.groups()
    if text is None:
        if sign != "~":
            raise UsageError(f"{word}: expected key=value, for example {key}=...")
        return word, [None], False
    values, sweeps = read_value(sign + key, text)
    return sign + key, values, sweeps


def read_value(key: str, text: str) -> tuple[list[Any], bool]:
    """Return the values of the text after ``=``, and whether it is a sweep.

    Args:
        key: key of the override, for error messages.
        text: value in Hydra's grammar.

    Raises:
        UsageError: a value that Hydra's grammar does not accept, or that a scene file cannot hold.
    """
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.core.override_parser.types import ChoiceSweep, Override, RangeSweep
    from hydra.errors import HydraException

    try:
        override = OverridesParser.create().parse_override(f"x={text}")
        value = override.value()
        if not override.is_sweep_override():
            values, sweeps = [value], False
        elif isinstance(value, ChoiceSweep | RangeSweep):
            found = list(islice(override.sweep_iterator(), MAX_VALUES + 1))
            values, sweeps = [Override._convert_value(item) for item in found], True
        else:
            kind = type(value).__name__.removesuffix("Sweep").lower()
            raise UsageError(
                f"{key}: expected values a,b or choice(a,b) or range(a,b), got {text!r} ({kind} is no list of values)"
            )
    except HydraException as error:
        raise UsageError(f"{key}={text}: expected key=value ({parse_failure(error)})") from error
    except (ArithmeticError, ValueError) as error:  # a step of 0, NaN
        raise UsageError(f"{key}: expected values a,b or choice(a,b) or range(a,b), got {text!r}") from error
    if not values:
        raise UsageError(f"{key}: expected at least one value, got {text!r}")
    if len(values) > MAX_VALUES:
        raise UsageError(f"{key}: expected at most {MAX_VALUES} values, got {text!r}")
    for item in values:
        _check_value(key, item, text)
    return values, sweeps


def parse_failure(error: Exception) -> str:
    """Return in one line why Hydra cannot parse a word."""
    found = next((line for line in str(error).splitlines() if "evaluating" in line), "")
    return found.partition(": ")[2] or "quote what holds blanks, brackets or commas, as in key='a b'"


def _check_value(key: str, value: Any, text: str) -> None:
    """Refuse values that a scene file cannot hold: interpolations, and mappings whose keys are not text."""
    if isinstance(value, str) and "${" in value:
        raise UsageError(f"{key}: expected a value, got {text!r} (scenes know no interpolation)")
    if isinstance(value, dict):
        for name in value:
            if not isinstance(name, str):
                raise UsageError(f"{key}: expected text as keys, got {name!r} in {text!r}")
    for item in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
        _check_value(key, item, text)
