"""Real spherical harmonics of degree 0 to 3 and their slopes, with the signs and order of 3D Gaussian Splatting's files."""

import numba
import numpy as np

C0, C1 = np.float32(0.28209479177387814), np.float32(0.4886025119029199)
C2A, C2B, C2C = np.float32(1.0925484305920792), np.float32(0.31539156525252005), np.float32(0.5462742152960396)
C3A, C3B = np.float32(0.5900435899266435), np.float32(2.890611442640554)
C3C, C3D, C3E = np.float32(0.4570457994644658), np.float32(0.3731763325901154), np.float32(1.445305721320277)
_2, _3, _4, _6 = np.float32(2), np.float32(3), np.float32(4), np.float32(6)


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def basis(x, y, z, many, out):
    """The first `many` (1, 4, 9 or 16) functions at the unit vector (x, y, z)."""
    out[0] = C0
    if many < 4:
        return
    out[1], out[2], out[3] = -C1 * y, C1 * z, -C1 * x
    if many < 9:
        return
    xx, yy, zz = x * x, y * y, z * z
    out[4], out[5], out[6] = C2A * x * y, -C2A * y * z, C2B * (_2 * zz - xx - yy)
    out[7], out[8] = -C2A * x * z, C2C * (xx - yy)
    if many < 16:
        return
    out[9], out[10], out[11] = -C3A * y * (_3 * xx - yy), C3B * x * y * z, -C3C * y * (_4 * zz - xx - yy)
    out[12], out[13] = C3D * z * (_2 * zz - _3 * xx - _3 * yy), -C3C * x * (_4 * zz - xx - yy)
    out[14], out[15] = C3E * z * (xx - yy), -C3A * x * (xx - _3 * yy)


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _put(out, k, a, b, c):
    out[k, 0], out[k, 1], out[k, 2] = a, b, c


@numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def slopes(x, y, z, many, out):
    """How the first `many` functions change with x, y and z, as polynomials of them: out [16, 3]."""
    no = np.float32(0)
    _put(out, 0, no, no, no)
    if many < 4:
        return
    _put(out, 1, no, -C1, no)
    _put(out, 2, no, no, C1)
    _put(out, 3, -C1, no, no)
    if many < 9:
        return
    _put(out, 4, C2A * y, C2A * x, no)
    _put(out, 5, no, -C2A * z, -C2A * y)
    _put(out, 6, -_2 * C2B * x, -_2 * C2B * y, _4 * C2B * z)
    _put(out, 7, -C2A * z, no, -C2A * x)
    _put(out, 8, _2 * C2C * x, -_2 * C2C * y, no)
    if many < 16:
        return
    xx, yy, zz = x * x, y * y, z * z
    _put(out, 9, -_6 * C3A * x * y, -C3A * (_3 * xx - _3 * yy), no)
    _put(out, 10, C3B * y * z, C3B * x * z, C3B * x * y)
    _put(out, 11, _2 * C3C * x * y, -C3C * (_4 * zz - xx - _3 * yy), -_4 * _2 * C3C * y * z)
    _put(out, 12, -_6 * C3D * x * z, -_6 * C3D * y * z, C3D * (_6 * zz - _3 * xx - _3 * yy))
    _put(out, 13, -C3C * (_4 * zz - _3 * xx - yy), _2 * C3C * x * y, -_4 * _2 * C3C * x * z)
    _put(out, 14, _2 * C3E * x * z, -_2 * C3E * y * z, C3E * (xx - yy))
    _put(out, 15, -C3A * (_3 * xx - _3 * yy), _6 * C3A * x * y, no)
