"""Data: the virtual simulator's track sets, converters of public recordings, the map rasteriser."""
