"""The coordinate system an OpenDRIVE file states, where it states one that can be understood."""

import re
from collections import Counter

from pyproj import CRS
from pyproj.exceptions import CRSError

from shiftsim.data.opendrive.records import OpenDrive


def coordinate_system(od: OpenDrive, warnings: Counter[str]) -> CRS | None:
    """The system of the file's coordinates, or None for a local frame.

    Args:
        od: The file.
        warnings: Takes a count where the text had to be guessed at or could not be read.
    """
    text = od.geo_reference
    if not text:
        return None
    try:
        return CRS.from_user_input(text)
    except CRSError:
        pass
    found = re.findall(r"\+(lat_0|lon_0)=\s*([-+0-9.eE]+)", text)
    origin = " ".join(f"+{key}={value}" for key, value in found)
    if len({key for key, _ in found}) == 2:  # CARLA writes the origin and nothing else
        try:
            crs = CRS.from_proj4(f"+proj=tmerc {origin}")
        except CRSError:
            pass
        else:
            warnings["geoReference without a projection, taken as transverse Mercator"] += 1
            return crs
    warnings["geoReference that cannot be read, taken as a local frame"] += 1
    return None
