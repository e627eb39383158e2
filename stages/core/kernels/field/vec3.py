"""3-vectors, 3 x 3 matrices and quaternions for Triton kernels, as tuples of tensors of equal shape.

Matrices have nine entries in row-major order; quaternions are w x y z. `load3` and `store3` transfer one vector per
lane, with a mask and a stride between components; the `read` and `write` functions transfer consecutive scalars.
"""

import triton
import triton.language as tl


@triton.jit
def load3(at, stride, mask, other=0.0):
    """Load the vector with components at `at`, `at` + stride and `at` + 2 stride."""
    return (tl.load(at, mask=mask, other=other), tl.load(at + stride, mask=mask, other=other),
            tl.load(at + 2 * stride, mask=mask, other=other))  # fmt: skip


@triton.jit
def store3(at, stride, a, mask):
    """Store a vector with a stride between components."""
    tl.store(at, a[0], mask=mask)
    tl.store(at + stride, a[1], mask=mask)
    tl.store(at + 2 * stride, a[2], mask=mask)


@triton.jit
def read3(at):
    """Read a vector of consecutive scalars."""
    return (tl.load(at), tl.load(at + 1), tl.load(at + 2))


@triton.jit
def write3(at, a):
    """Write a vector as consecutive scalars."""
    tl.store(at, a[0])
    tl.store(at + 1, a[1])
    tl.store(at + 2, a[2])


@triton.jit
def read4(at):
    """Read four consecutive scalars."""
    return (tl.load(at), tl.load(at + 1), tl.load(at + 2), tl.load(at + 3))


@triton.jit
def write4(at, q):
    """Write four consecutive scalars."""
    write3(at, q)
    tl.store(at + 3, q[3])


@triton.jit
def read9(at):
    """Read a matrix of consecutive scalars."""
    return (tl.load(at), tl.load(at + 1), tl.load(at + 2), tl.load(at + 3), tl.load(at + 4), tl.load(at + 5),
            tl.load(at + 6), tl.load(at + 7), tl.load(at + 8))  # fmt: skip


@triton.jit
def write9(at, M):
    """Write a matrix as consecutive scalars."""
    for i in tl.static_range(9):
        tl.store(at + i, M[i])


@triton.jit
def add(a, b):
    """a + b."""
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


@triton.jit
def sub(a, b):
    """a - b."""
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


@triton.jit
def scale3(s, a):
    """s a."""
    return (s * a[0], s * a[1], s * a[2])


@triton.jit
def dot(a, b):
    """a . b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@triton.jit
def cross(a, b):
    """a x b."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@triton.jit
def matvec3(M, a):
    """M a."""
    return (M[0] * a[0] + M[1] * a[1] + M[2] * a[2], M[3] * a[0] + M[4] * a[1] + M[5] * a[2],
            M[6] * a[0] + M[7] * a[1] + M[8] * a[2])  # fmt: skip


@triton.jit
def transposed_matvec3(M, a):
    """M^T a."""
    return (M[0] * a[0] + M[3] * a[1] + M[6] * a[2], M[1] * a[0] + M[4] * a[1] + M[7] * a[2],
            M[2] * a[0] + M[5] * a[1] + M[8] * a[2])  # fmt: skip


@triton.jit
def rotate_tensor(R, M):
    """R M R^T."""
    a = matvec3(R, (M[0], M[3], M[6]))  # columns of R M
    b = matvec3(R, (M[1], M[4], M[7]))
    c = matvec3(R, (M[2], M[5], M[8]))
    x = matvec3(R, (a[0], b[0], c[0]))  # rows of the result
    y = matvec3(R, (a[1], b[1], c[1]))
    z = matvec3(R, (a[2], b[2], c[2]))
    return (x[0], x[1], x[2], y[0], y[1], y[2], z[0], z[1], z[2])


@triton.jit
def solve_symmetric(K, a, b):
    """K^-1 a and K^-1 b for a symmetric K (xx, xy, xz, yy, yz, zz), by Cramer's rule."""
    x, y, z = (K[0], K[1], K[2]), (K[1], K[3], K[4]), (K[2], K[4], K[5])
    yz, zx, xy = cross(y, z), cross(z, x), cross(x, y)
    det = dot(x, yz)
    return (
        scale3(1 / det, add(add(scale3(a[0], yz), scale3(a[1], zx)), scale3(a[2], xy))),
        scale3(1 / det, add(add(scale3(b[0], yz), scale3(b[1], zx)), scale3(b[2], xy))),
    )


@triton.jit
def _larger(ax, ay, az, bx, by, bz):
    return tl.maximum(ax, bx), tl.maximum(ay, by), tl.maximum(az, bz)


@triton.jit
def _both(ax, ay, az, bx, by, bz):
    return ax + bx, ay + by, az + bz


@triton.jit
def sum3(a):
    """Sum of each component over the first dimension."""
    return tl.reduce((a[0], a[1], a[2]), 0, _both)


@triton.jit
def max3(a):
    """Maximum of each component over the first dimension."""
    return tl.reduce((a[0], a[1], a[2]), 0, _larger)


@triton.jit
def where3(mask, a, other):
    """The vector a where `mask`, else the scalar `other` in each component."""
    return (tl.where(mask, a[0], other), tl.where(mask, a[1], other), tl.where(mask, a[2], other))


@triton.jit
def rotation_matrix(q):
    """Rotation matrix of a quaternion of any norm."""
    s = 1 / tl.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    w, x, y, z = q[0] * s, q[1] * s, q[2] * s, q[3] * s
    return (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
            2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
            2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y))  # fmt: skip


@triton.jit
def rotate_quat(q, turn):
    """Unit quaternion q after the rotation vector `turn` [rad] in world axes."""
    half = tl.sqrt(dot(turn, turn) + 1e-24) / 2
    a, v = tl.cos(half), scale3(tl.sin(half) / half / 2, turn)
    u = (q[1], q[2], q[3])
    w = a * q[0] - dot(v, u)
    x, y, z = add(add(scale3(a, u), scale3(q[0], v)), cross(v, u))
    s = 1 / tl.sqrt(w * w + x * x + y * y + z * z)
    return (w * s, x * s, y * s, z * s)


@triton.jit
def angular_velocity(q, momentum, inverse):
    """Angular velocity [rad/s] at orientation q, from angular momentum and the inverse inertia in the body frame."""
    R = rotation_matrix(q)
    return matvec3(R, matvec3(inverse, transposed_matvec3(R, momentum)))


@triton.jit
def drift(com, q, velocity, momentum, inverse, dt):
    """Centre of mass and orientation after free motion for dt [s], with the angular velocity at the midpoint."""
    middle = rotate_quat(q, scale3(dt / 2, angular_velocity(q, momentum, inverse)))
    return add(com, scale3(dt, velocity)), rotate_quat(q, scale3(dt, angular_velocity(middle, momentum, inverse)))
