"""The submap's filter, compiled. numba types the arguments by itself."""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, error_model="numpy")
def predict_kernel(mean, cov, d, move, q):
    c, s = np.cos(mean[2]), np.sin(mean[2])
    dx = c * move[0] - s * move[1]
    dy = s * move[0] + c * move[1]
    mean[0] += dx
    mean[1] += dy
    mean[2] += move[2]
    for j in range(d):  # F = [[1, 0, -dy], [0, 1, dx], [0, 0, 1]]
        cov[0, j] -= dy * cov[2, j]
        cov[1, j] += dx * cov[2, j]
    for j in range(d):
        cov[j, 0] -= dy * cov[j, 2]
        cov[j, 1] += dx * cov[j, 2]
    # Noise is given in the robot's frame before the step.
    a = c * c * q[0, 0] + s * s * q[1, 1] - 2 * c * s * q[0, 1]
    b = s * s * q[0, 0] + c * c * q[1, 1] + 2 * c * s * q[0, 1]
    o = c * s * (q[0, 0] - q[1, 1]) + (c * c - s * s) * q[0, 1]
    cov[0, 0] += a
    cov[1, 1] += b
    cov[0, 1] += o
    cov[1, 0] += o
    cov[2, 2] += q[2, 2]
    ux = c * q[0, 2] - s * q[1, 2]
    uy = s * q[0, 2] + c * q[1, 2]
    cov[0, 2] += ux
    cov[2, 0] += ux
    cov[1, 2] += uy
    cov[2, 1] += uy


@njit(cache=True, error_model="numpy")
def innovations_kernel(mean, cov, n, z, R):
    m2 = np.empty((len(z), n))
    logdet = np.empty((len(z), n))
    c, s = np.cos(mean[2]), np.sin(mean[2])
    for k in range(n):
        a = 3 + 2 * k
        ex, ey = mean[a] - mean[0], mean[a + 1] - mean[1]
        hx, hy = c * ex + s * ey, -s * ex + c * ey
        # H over (x, y, yaw, lx, ly)
        S00, S01, S11 = project_kernel(cov, a, c, s, hx, hy)
        for i in range(len(z)):
            p, q, r = S00 + R[i, 0, 0], S01 + R[i, 0, 1], S11 + R[i, 1, 1]
            det = p * r - q * q
            vx, vy = z[i, 0] - hx, z[i, 1] - hy
            m2[i, k] = (vx * vx * r - 2 * vx * vy * q + vy * vy * p) / det
            logdet[i, k] = np.log(det)
    return m2, logdet


@njit(cache=True, error_model="numpy")
def project_kernel(cov, a, c, s, hx, hy):
    H = np.empty((2, 5))
    H[0, 0], H[0, 1], H[0, 2], H[0, 3], H[0, 4] = -c, -s, hy, c, s
    H[1, 0], H[1, 1], H[1, 2], H[1, 3], H[1, 4] = s, -c, -hx, -s, c
    index = np.array([0, 1, 2, a, a + 1])
    out = np.zeros(3)
    for i in range(5):
        for j in range(5):
            v = cov[index[i], index[j]]
            out[0] += H[0, i] * v * H[0, j]
            out[1] += H[0, i] * v * H[1, j]
            out[2] += H[1, i] * v * H[1, j]
    return out[0], out[1], out[2]


@njit(cache=True, error_model="numpy")
def update_kernel(mean, cov, d, k, z, R):
    a = 3 + 2 * k
    c, s = np.cos(mean[2]), np.sin(mean[2])
    ex, ey = mean[a] - mean[0], mean[a + 1] - mean[1]
    hx, hy = c * ex + s * ey, -s * ex + c * ey
    PH = np.empty((d, 2))
    for j in range(d):
        PH[j, 0] = -c * cov[j, 0] - s * cov[j, 1] + hy * cov[j, 2] + c * cov[j, a] + s * cov[j, a + 1]
        PH[j, 1] = s * cov[j, 0] - c * cov[j, 1] - hx * cov[j, 2] - s * cov[j, a] + c * cov[j, a + 1]
    p = -c * PH[0, 0] - s * PH[1, 0] + hy * PH[2, 0] + c * PH[a, 0] + s * PH[a + 1, 0] + R[0, 0]
    q = -c * PH[0, 1] - s * PH[1, 1] + hy * PH[2, 1] + c * PH[a, 1] + s * PH[a + 1, 1] + R[0, 1]
    r = s * PH[0, 1] - c * PH[1, 1] - hx * PH[2, 1] - s * PH[a, 1] + c * PH[a + 1, 1] + R[1, 1]
    return gain_kernel(mean, cov, d, PH, p, q, r, z[0] - hx, z[1] - hy)


@njit(cache=True, error_model="numpy")
def fix_kernel(mean, cov, d, k, place, C):
    a = 3 + 2 * k
    PH = cov[:d, a : a + 2].copy()
    p, q, r = cov[a, a] + C[0, 0], cov[a, a + 1] + C[0, 1], cov[a + 1, a + 1] + C[1, 1]
    return gain_kernel(mean, cov, d, PH, p, q, r, place[0] - mean[a], place[1] - mean[a + 1])


@njit(cache=True, error_model="numpy")
def gain_kernel(mean, cov, d, PH, p, q, r, vx, vy):
    det = p * r - q * q
    ip, iq, ir = r / det, -q / det, p / det
    wx, wy = ip * vx + iq * vy, iq * vx + ir * vy
    for i in range(d):
        k0 = PH[i, 0] * ip + PH[i, 1] * iq
        k1 = PH[i, 0] * iq + PH[i, 1] * ir
        mean[i] += PH[i, 0] * wx + PH[i, 1] * wy
        for j in range(d):
            cov[i, j] -= k0 * PH[j, 0] + k1 * PH[j, 1]
    return vx * wx + vy * wy, np.log(det)


@njit(cache=True, error_model="numpy")
def add_kernel(mean, cov, a, z, R):
    c, s = np.cos(mean[2]), np.sin(mean[2])
    gx, gy = c * z[0] - s * z[1], s * z[0] + c * z[1]
    mean[a] = mean[0] + gx
    mean[a + 1] = mean[1] + gy
    for j in range(a):
        cov[a, j] = cov[0, j] - gy * cov[2, j]
        cov[a + 1, j] = cov[1, j] + gx * cov[2, j]
        cov[j, a] = cov[a, j]
        cov[j, a + 1] = cov[a + 1, j]
    cov[a, a] = cov[a, 0] - gy * cov[a, 2] + c * c * R[0, 0] + s * s * R[1, 1] - 2 * c * s * R[0, 1]
    cov[a + 1, a + 1] = cov[a + 1, 1] + gx * cov[a + 1, 2] + s * s * R[0, 0] + c * c * R[1, 1] + 2 * c * s * R[0, 1]
    cov[a, a + 1] = cov[a, 1] + gx * cov[a, 2] + c * s * (R[0, 0] - R[1, 1]) + (c * c - s * s) * R[0, 1]
    cov[a + 1, a] = cov[a, a + 1]


@njit(cache=True, error_model="numpy")
def assign(m2, logdet, gate):
    """Landmark (N,) of each detection, -1 none: best pairs first, each landmark once.

    A pair's cost is its chi-square plus ln |S|: a landmark that is badly known does not take every detection.
    """
    n, k = m2.shape
    out = np.full(n, -1, np.int64)
    taken = np.zeros(k, np.bool_)
    while True:
        best, bi, bk = 1e18, -1, -1
        for i in range(n):
            if out[i] >= 0:
                continue
            for j in range(k):
                if not taken[j] and m2[i, j] < gate and m2[i, j] + logdet[i, j] < best:
                    best, bi, bk = m2[i, j] + logdet[i, j], i, j
        if bi < 0:
            return out
        out[bi] = bk
        taken[bk] = True


@njit(cache=True, error_model="numpy")
def in_view(mean, n, blocked):
    """Range (n,) of each landmark and whether a nearer trunk hides it."""
    reach = np.empty(n)
    hidden = np.zeros(n, np.bool_)
    s = len(blocked)
    for k in range(n):
        dx, dy = mean[3 + 2 * k] - mean[0], mean[4 + 2 * k] - mean[1]
        reach[k] = np.hypot(dx, dy)
        at = int((np.arctan2(dy, dx) - mean[2]) * s / (2 * np.pi) + 1.5 * s) % s
        hidden[k] = blocked[at] < reach[k] - 1.0
    return reach, hidden


@njit(cache=True, error_model="numpy")
def enter_kernel(raster, origin, x, y, yaw, blocked, bins, chance, view):
    s = len(blocked)
    for i in range(max(0, int(x - view - origin[0])), min(raster.shape[0], int(x + view - origin[0]) + 1)):
        for j in range(max(0, int(y - view - origin[1])), min(raster.shape[1], int(y + view - origin[1]) + 1)):
            dx, dy = origin[0] + i + 0.5 - x, origin[1] + j + 0.5 - y
            r = np.sqrt(dx * dx + dy * dy)
            if r > view:
                continue
            at = int((np.arctan2(dy, dx) - yaw) * s / (2 * np.pi) + 1.5 * s) % s
            if blocked[at] < r - 1.0:
                continue
            b = 0
            while r > bins[b]:
                b += 1
            raster[i, j] -= np.log(1.0 - chance[b])
