"""Read the statements of Wavefront OBJ text.

:mod:`torchpt.scene.meshes.obj_text` calls these kernels and says which text is in the usual form. The last byte of a text is
a line break, where all loops along a line end.
"""

from __future__ import annotations

import numpy as np

from kernel_sources.jit import BYTES, DOUBLES, INT, INTS, LONGS, inner, kernel
from kernel_sources.simd import item, put

__all__ = ["count", "distinct", "read"]

_TAB, _NEWLINE, _SPACE, _HASH, _PLUS, _MINUS, _DOT, _SLASH = (ord(sign) for sign in "\t\n #+-./")
_ZERO, _NINE, _BIG_E, _BACKSLASH, _E, _F, _N, _T, _V = (ord(sign) for sign in "09E\\efntv")
#: What a line says: a position, texture coordinates, a normal, a face, nothing (a comment too), or anything else.
_POSITION, _UV, _NORMAL, _FACE, _NOTHING, _OTHER = range(6)
#: Largest integer below which all are float64, and the largest power of ten that is one: a product or quotient of two such
#: numbers is rounded once, as the text is.
_EXACT, _POWERS = 1 << 53, 22
#: A number of more digits than this is not computed here; ten times as much and a digit fit in an int64.
_MOST = 10**17
#: No file has so many elements.
_FAR = 10**12


@inner(forceinline=True)
def _at(text, at):
    return np.int64(item(text, at))


@inner(forceinline=True)
def _blank(sign):
    return (sign == _SPACE) | (sign == _TAB)


@inner(forceinline=True)
def _behind_blanks(text, at):
    while _blank(_at(text, at)):
        at += 1
    return at


@inner(forceinline=True)
def _key(text, at):
    """Return what the line at ``at`` says."""
    first = _at(text, at)
    if first == _V:
        second = _at(text, at + 1)
        if _blank(second) or second == _NEWLINE:
            return _POSITION
        if second == _T or second == _N:
            third = _at(text, at + 2)
            if _blank(third) or third == _NEWLINE:
                return _UV if second == _T else _NORMAL
        return _OTHER
    if first == _F:
        second = _at(text, at + 1)
        return _FACE if _blank(second) or second == _NEWLINE else _OTHER
    if first == _HASH or _at(text, _behind_blanks(text, at)) == _NEWLINE:
        return _NOTHING
    return _OTHER


@kernel("obj_text", BYTES, INT, LONGS)
def count(text, length, counts):
    """Count what a text holds.

    Args:
        text: ``(length,)`` bytes.
        length: how many.
        counts: ``(6,)``, set: lines of positions, texture coordinates, normals and faces; corners of all faces; other lines.

    Returns:
        1; 0 for text with bytes beyond ASCII, control characters, or lines that go on behind a backslash.
    """
    for k in range(6):
        put(counts, k, 0)
    at, usual = np.int64(0), True
    while at < length:
        key = _key(text, at)
        words, before = 0, True
        sign = _at(text, at)
        while sign != _NEWLINE:
            blank = _blank(sign)
            words += before and not blank
            before = blank
            usual &= blank | ((sign > _SPACE) & (sign < 128))
            at += 1
            sign = _at(text, at)
        if at > 0:
            usual &= _at(text, at - 1) != _BACKSLASH
        at += 1
        if key == _OTHER:
            put(counts, 5, item(counts, 5) + 1)
        elif key != _NOTHING:
            put(counts, key, item(counts, key) + 1)
            if key == _FACE:
                put(counts, 4, item(counts, 4) + words - 1)
    return np.int64(usual)


@inner(forceinline=True)
def _number(text, at, powers):
    """Return the number at ``at``, the place behind it, and whether it is right to the last bit.

    The place is -1 where there is no number, or one in another form than sign, digits, point, digits and exponent.
    """
    sign = _at(text, at)
    negative = sign == _MINUS
    if negative or sign == _PLUS:
        at += 1
    mantissa, scale, exact, digits = np.int64(0), np.int64(0), True, 0
    sign = _at(text, at)
    while _ZERO <= sign <= _NINE:
        if mantissa < _MOST:
            mantissa = mantissa * 10 + (sign - _ZERO)
        else:
            exact = False
        digits += 1
        at += 1
        sign = _at(text, at)
    if sign == _DOT:
        at += 1
        sign = _at(text, at)
        while _ZERO <= sign <= _NINE:
            if mantissa < _MOST:
                mantissa = mantissa * 10 + (sign - _ZERO)
                scale -= 1
            else:
                exact = False
            digits += 1
            at += 1
            sign = _at(text, at)
    if digits == 0:
        return 0.0, np.int64(-1), False
    if sign == _E or sign == _BIG_E:
        at += 1
        sign = _at(text, at)
        down = sign == _MINUS
        if down or sign == _PLUS:
            at += 1
            sign = _at(text, at)
        power, digits = np.int64(0), 0
        while _ZERO <= sign <= _NINE:
            power = min(power * 10 + (sign - _ZERO), 10000)
            digits += 1
            at += 1
            sign = _at(text, at)
        if digits == 0:
            return 0.0, np.int64(-1), False
        scale += -power if down else power
    if not _blank(sign) and sign != _NEWLINE:
        return 0.0, np.int64(-1), False
    value = np.float64(mantissa)
    if mantissa > 0:
        exact &= (mantissa <= _EXACT) & (scale >= -_POWERS) & (scale <= _POWERS)
        if exact:
            value = value / item(powers, -scale) if scale < 0 else value * item(powers, scale)
    return (-value if negative else value), at, exact


@inner(forceinline=True)
def _index(text, at, before, size):
    """Return the index from 0 at ``at``, and the place behind it.

    Negative ones count back from ``before``, the number of elements before the line. The index is -1 where there are no
    digits; the place is -1 where the index is none of ``size`` elements.
    """
    sign = _at(text, at)
    negative = sign == _MINUS
    if negative:
        at += 1
        sign = _at(text, at)
    value, digits = np.int64(0), 0
    while _ZERO <= sign <= _NINE:
        value = min(value * 10 + (sign - _ZERO), _FAR)
        digits += 1
        at += 1
        sign = _at(text, at)
    if digits == 0:
        return np.int64(-1), (np.int64(-1) if negative else at)
    index = before - value if negative else value - 1
    if value == 0 or index < 0 or index >= size:
        return np.int64(-1), np.int64(-1)
    return index, at


@kernel("obj_text", BYTES, INT, DOUBLES, LONGS, DOUBLES, LONGS, LONGS, LONGS, LONGS)
def read(text, length, powers, counts, numbers, corners, sides, others, inexact):
    """Read a text that :func:`count` has counted.

    Args:
        text: ``(length,)`` bytes.
        length: how many.
        powers: ``(23,)`` powers of ten from 1 on.
        counts: ``(6,)`` by :func:`count`.
        numbers: set: positions ``(v, 3)``, behind them texture coordinates ``(vt, 2)``, behind them normals ``(vn, 3)``.
        corners: ``(corners, 3)``, set: indices v, vt, vn from 0 of each corner of each face, -1 where there is none.
        sides: ``(faces,)``, set: how many corners each face has.
        others: ``(other lines, 2)``, set: where each begins, and how many faces come before it.
        inexact: ``(all numbers, 3)``, the first rows set: index in ``numbers``, begin and end of the text of numbers that
            may be wrong in the last bit, and are to be read by other means.

    Returns:
        The number of rows of ``inexact``; -1 for text that is not in the usual form.
    """
    done_v, done_vt, done_vn, done_f, corner, other, unsure = 0, 0, 0, 0, 0, 0, 0
    v, vt, vn = item(counts, 0), item(counts, 1), item(counts, 2)
    at = np.int64(0)
    while at < length:
        key = _key(text, at)
        if key >= _NOTHING:
            if key == _OTHER:
                put(others, 2 * other, at)
                put(others, 2 * other + 1, done_f)
                other += 1
            while _at(text, at) != _NEWLINE:
                at += 1
        elif key == _FACE:
            first = corner
            at = _behind_blanks(text, at + 1)
            while _at(text, at) != _NEWLINE:
                index, at = _index(text, at, done_v, v)
                if at < 0 or index < 0:
                    return np.int64(-1)
                put(corners, 3 * corner, index)
                put(corners, 3 * corner + 1, -1)
                put(corners, 3 * corner + 2, -1)
                if _at(text, at) == _SLASH:
                    index, at = _index(text, at + 1, done_vt, vt)
                    if at < 0 or (index < 0 and _at(text, at) != _SLASH):
                        return np.int64(-1)
                    put(corners, 3 * corner + 1, index)
                    if _at(text, at) == _SLASH:
                        index, at = _index(text, at + 1, done_vn, vn)
                        if at < 0 or index < 0:
                            return np.int64(-1)
                        put(corners, 3 * corner + 2, index)
                if not _blank(_at(text, at)) and _at(text, at) != _NEWLINE:
                    return np.int64(-1)
                corner += 1
                at = _behind_blanks(text, at)
            if corner - first < 3:
                return np.int64(-1)
            put(sides, done_f, corner - first)
            done_f += 1
        else:
            if key == _POSITION:
                place, least, most = 3 * done_v, 3, 3
                done_v += 1
            elif key == _UV:
                place, least, most = 3 * v + 2 * done_vt, 2, 3
                done_vt += 1
            else:
                place, least, most = 3 * v + 2 * vt + 3 * done_vn, 3, 3
                done_vn += 1
            at = _behind_blanks(text, at + (1 if key == _POSITION else 2))
            found = 0
            while _at(text, at) != _NEWLINE:
                begin = at
                value, at, exact = _number(text, at, powers)
                if at < 0 or found == most:
                    return np.int64(-1)
                if found < least:
                    put(numbers, place + found, value)
                    if not exact:
                        put(inexact, 3 * unsure, place + found)
                        put(inexact, 3 * unsure + 1, begin)
                        put(inexact, 3 * unsure + 2, at)
                        unsure += 1
                found += 1
                at = _behind_blanks(text, at)
            if found < least:
                return np.int64(-1)
        at += 1
    return np.int64(unsure)


@kernel("obj_text", LONGS, INT, INTS, INT, LONGS)
def distinct(corners, count, table, size, rows):
    """Keep the first of equal corners, in the order of the file.

    Args:
        corners: ``(count, 3)``, changed: the first rows become the distinct ones.
        count: number of corners.
        table: ``(size,)`` scratch memory, all -1.
        size: a power of two, at least twice ``count``.
        rows: ``(count,)``, set: the row of each corner among the distinct ones.

    Returns:
        How many distinct ones there are.
    """
    found = np.int64(0)
    for k in range(count):
        a, b, c = item(corners, 3 * k), item(corners, 3 * k + 1), item(corners, 3 * k + 2)
        mixed = (a * 0x9E3779B1 + b) * 0x85EBCA77 + c
        mixed = (mixed ^ (mixed >> 29)) * 0x27D4EB2F165667C5
        place = (mixed >> 24) & (size - 1)
        while True:
            row = np.int64(item(table, place))
            if row < 0:
                put(table, place, np.int32(found))
                put(corners, 3 * found, a)
                put(corners, 3 * found + 1, b)
                put(corners, 3 * found + 2, c)
                row = found
                found += 1
                break
            if item(corners, 3 * row) == a and item(corners, 3 * row + 1) == b and item(corners, 3 * row + 2) == c:
                break
            place = (place + 1) & (size - 1)
        put(rows, k, row)
    return found
