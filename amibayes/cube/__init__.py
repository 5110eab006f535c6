"""Image cubes: what a detector recorded, with its errors, flags and orientation."""

from amibayes.cube.container import DO_NOT_USE, DQ_FLAGS, JUMP_DET, SATURATED, Cube
from amibayes.cube.read import CubeFile, open_cube, read_cube
from amibayes.cube.stream import EmptyImage, FitsStream
from amibayes.cube.write import CubeStream, cube_stream, header_of, headers_of, write_cube

__all__ = [
    "DO_NOT_USE",
    "DQ_FLAGS",
    "JUMP_DET",
    "SATURATED",
    "Cube",
    "CubeFile",
    "CubeStream",
    "EmptyImage",
    "FitsStream",
    "cube_stream",
    "header_of",
    "headers_of",
    "open_cube",
    "read_cube",
    "write_cube",
]
