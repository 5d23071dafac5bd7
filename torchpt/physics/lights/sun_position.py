"""Where the sun stands at a place and a time.

Source: Blanco-Muriel, Alarcón-Padilla, López-Moratalla and Lara-Coira, *Computing the Solar Vector*, Solar Energy 70(5), 2001
(the PSA algorithm), accurate to about half a minute of arc from 1999 to 2015. Mitsuba uses it too, in single precision.
"""

from __future__ import annotations

import math
from datetime import date

__all__ = ["sun_angles"]

#: Radius of the Earth over its distance from the sun.
_PARALLAX = 6371.01 / 149597890.0
#: Days from 1 January of the year 1 to the epoch, noon of 1 January 2000.
_EPOCH = date(2000, 1, 1).toordinal() + 0.5


def sun_angles(
    latitude: float, longitude: float, timezone: float, year: int, month: int, day: int, hours: float
) -> tuple[float, float]:
    """Return the angle from the zenith, and the azimuth from north over east, both in radians.

    Args:
        latitude: in degrees, north is positive.
        longitude: in degrees, east is positive.
        timezone: hours ahead of Greenwich; summer time counts as one of them.
        year: of the Gregorian calendar.
        month: 1 to 12.
        day: 1 to 31; one that the month lacks counts on into the next.
        hours: local time since midnight.
    """
    hours = hours - timezone
    days = date(year, month, 1).toordinal() + (day - 1) - _EPOCH + hours / 24.0
    # The sun on the ecliptic.
    omega = 2.1429 - 0.0010394594 * days
    mean_longitude = 4.8950630 + 0.017202791698 * days
    anomaly = 6.2400600 + 0.0172019699 * days
    ecliptic = (
        mean_longitude
        + 0.03341607 * math.sin(anomaly)
        + 0.00034894 * math.sin(2.0 * anomaly)
        - 0.0001134
        - 0.0000203 * math.sin(omega)
    )
    obliquity = 0.4090928 - 6.2140e-9 * days + 0.0000396 * math.cos(omega)
    # In the sky of the stars.
    right_ascension = math.atan2(math.cos(obliquity) * math.sin(ecliptic), math.cos(ecliptic))
    declination = math.asin(math.sin(obliquity) * math.sin(ecliptic))
    # Over the place.
    sidereal = 6.6974243242 + 0.0657098283 * days + hours  # of Greenwich, in hours
    turned = math.radians(15.0 * sidereal + longitude) - right_ascension
    here = math.radians(latitude)
    cosine = math.cos(here) * math.cos(turned) * math.cos(declination) + math.sin(declination) * math.sin(here)
    zenith = math.acos(max(-1.0, min(1.0, cosine)))
    north = math.tan(declination) * math.cos(here) - math.sin(here) * math.cos(turned)
    azimuth = math.atan2(-math.sin(turned), north) % math.tau
    return zenith + _PARALLAX * math.sin(zenith), azimuth
