"""Adam on flat arrays, and the bounded parameters of Gaussians: logarithms of scales, logits of opacities."""

import warp as wp

from warprrf.cache import once

FIRST_DECAY, SECOND_DECAY, EPSILON = 0.9, 0.999, 1e-15  # as Gaussian splatting publishes them


@wp.kernel(enable_backward=False)
def activate(
    offset: int,
    log_scales: wp.array(dtype=wp.vec3),
    logits: wp.array(dtype=float),
    scales: wp.array(dtype=wp.vec3),
    opacities: wp.array(dtype=float),
):
    """Scales and opacities from what Adam moves."""
    i = offset + wp.tid()
    s = log_scales[i]
    scales[i] = wp.vec3(wp.exp(s[0]), wp.exp(s[1]), wp.exp(s[2]))
    opacities[i] = 1.0 / (1.0 + wp.exp(-logits[i]))


@wp.kernel(enable_backward=False)
def activate_adjoint(
    offset: int,
    scales: wp.array(dtype=wp.vec3),
    opacities: wp.array(dtype=float),
    scales_grad: wp.array(dtype=wp.vec3),
    opacities_grad: wp.array(dtype=float),
    log_scales_grad: wp.array(dtype=wp.vec3),
    logits_grad: wp.array(dtype=float),
):
    """Chain rule through :func:`activate`."""
    i = offset + wp.tid()
    log_scales_grad[i] = wp.cw_mul(scales_grad[i], scales[i])
    logits_grad[i] = opacities_grad[i] * opacities[i] * (1.0 - opacities[i])


@wp.kernel(enable_backward=False)
def accumulate(
    offset: int,
    origin: wp.vec3,
    means: wp.array(dtype=wp.vec3),
    means_grad: wp.array(dtype=wp.vec3),
    weight: wp.array(dtype=float),
    pull: wp.array(dtype=float),
    hits: wp.array(dtype=float),
    seen: wp.array(dtype=float),
):
    """Densification statistics: gradient of the projected position (times the focal length), views, blending weight."""
    i = offset + wp.tid()
    if weight[i] > 0.0:
        pull[i] = pull[i] + wp.length(means_grad[i]) * wp.length(means[i] - origin)
        seen[i] = seen[i] + weight[i]
    hits[i] = hits[i] + 1.0


@once
def build_adam(real: type) -> wp.Kernel:
    """The kernel of one step, for ``wp.float32`` or ``wp.float64``."""
    d1, d2, epsilon = (wp.constant(real(value)) for value in (FIRST_DECAY, SECOND_DECAY, EPSILON))

    @wp.kernel(module="unique", enable_backward=False)
    def adam(
        offset: int,
        width: int,
        rates: wp.array(dtype=real),
        first_correction: real,
        second_correction: real,
        ridge: wp.array(dtype=real),
        initial: wp.array(dtype=real),
        gradient: wp.array(dtype=real),
        first: wp.array(dtype=real),
        second: wp.array(dtype=real),
        values: wp.array(dtype=real),
    ):
        """One step (Kingma and Ba 2015) on rows of ``width`` numbers; clears the gradient. ``ridge`` pulls a row's first
        number to ``initial`` and the others to zero; empty for none."""
        row = offset + wp.tid()
        for k in range(width):
            e = row * width + k
            g = gradient[e]
            if ridge.shape[0] > 0:
                away = values[e]
                if k == 0:
                    away -= initial[row]
                g += ridge[k] * away
            m = d1 * first[e] + (real(1.0) - d1) * g
            v = d2 * second[e] + (real(1.0) - d2) * g * g
            first[e] = m
            second[e] = v
            values[e] = values[e] - rates[k] * first_correction * m / (
                wp.sqrt(second_correction * v) + epsilon
            )
            gradient[e] = real(0.0)

    return adam


def corrections(step: int) -> tuple[float, float]:
    """What Adam multiplies its moments by after ``step`` steps."""
    return 1 / (1 - FIRST_DECAY**step), 1 / (1 - SECOND_DECAY**step)


@wp.kernel(enable_backward=False)
def pull_to_planes(
    offset: int,
    plane_of: wp.array(dtype=int),
    planes: wp.array(dtype=wp.vec4),
    strength: float,
    thickness: float,
    means: wp.array(dtype=wp.vec3),
    quaternions: wp.array(dtype=wp.vec4),
    log_scales: wp.array(dtype=wp.vec3),
):
    """Move a Gaussian towards its plane, turn its thin axis (the third) to the normal, keep it thin.

    The proximal step of a quadratic penalty: ``strength`` is the share of the deviation removed.
    """
    i = offset + wp.tid()
    s = log_scales[i]
    log_scales[i] = wp.vec3(s[0], s[1], wp.min(s[2], wp.log(thickness)))
    p = plane_of[i]
    if p < 0:
        return
    normal = wp.vec3(planes[p][0], planes[p][1], planes[p][2])
    x = means[i]
    means[i] = x - strength * (wp.dot(normal, x) - planes[p][3]) * normal
    q = wp.normalize(quaternions[i])
    axis = wp.vec3(
        2.0 * (q[1] * q[3] + q[0] * q[2]),
        2.0 * (q[2] * q[3] - q[0] * q[1]),
        1.0 - 2.0 * (q[1] * q[1] + q[2] * q[2]),
    )
    if wp.dot(axis, normal) < 0.0:
        normal = -normal
    turn = 0.5 * strength * wp.cross(axis, normal)  # half the rotation vector, small angle
    quaternions[i] = wp.normalize(
        wp.vec4(
            q[0] - turn[0] * q[1] - turn[1] * q[2] - turn[2] * q[3],
            q[1] + turn[0] * q[0] + turn[1] * q[3] - turn[2] * q[2],
            q[2] - turn[0] * q[3] + turn[1] * q[0] + turn[2] * q[1],
            q[3] + turn[0] * q[2] - turn[1] * q[1] + turn[2] * q[0],
        )
    )
