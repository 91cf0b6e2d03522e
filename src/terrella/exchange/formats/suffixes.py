"""The endings of files that are films and pictures."""

from __future__ import annotations

VIDEOS = frozenset(
    ".mp4 .m4v .mov .mkv .webm .avi .mpg .mpeg .ts .m2ts .mts .wmv .flv .ogv .3gp .gif .nut .y4m .h264 .264 .h265 .hevc".split()
)
IMAGES = frozenset(".png .jpg .jpeg .webp .bmp .tif .tiff .ppm .pgm".split())
