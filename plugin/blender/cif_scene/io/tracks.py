"""Poses over time. Quaternions are (w, x, y, z) and unit; translation is linear, rotation spherical."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

MAX_TURN = np.radians(5.0)
"""Largest turn between keys that tools interpolate per component; doing so errs by less than 0.001 degrees."""


@dataclass(frozen=True)
class Track:
    """Poses at ascending time codes, held outside them; a single one stands still."""

    codes: np.ndarray
    """Time codes, [T] float64."""
    translations: np.ndarray
    """[T, 3] float64."""
    rotations: np.ndarray
    """Unit quaternions, each in the hemisphere of the one before, [T, 4] float64."""
    scales: np.ndarray
    """Scales along the own axes, [T, 3] float64; a mirrored frame has a negative first one."""

    @property
    def moves(self) -> bool:
        """Whether the poses differ."""
        return not all(
            np.allclose(values, values[:1], rtol=0, atol=1e-9)
            for values in (self.translations, self.rotations, self.scales)
        )

    @property
    def is_identity(self) -> bool:
        """Whether every pose is the frame itself."""
        return all(
            np.allclose(values, rest, rtol=0, atol=1e-9)
            for values, rest in (
                (self.translations, 0.0),
                (np.abs(self.rotations), [1.0, 0.0, 0.0, 0.0]),
                (self.scales, 1.0),
            )
        )

    def matrices(self, codes: np.ndarray) -> np.ndarray:
        """Poses at time codes [M] as column-vector matrices [M, 4, 4]."""
        codes = np.asarray(codes, dtype=np.float64)
        last = len(self.codes) - 1
        if last == 0:
            after = np.zeros(len(codes), dtype=int)
            before, fraction = after, np.zeros(len(codes))
        else:
            after = np.clip(np.searchsorted(self.codes, codes, side="right"), 1, last)
            before = after - 1
            span = self.codes[after] - self.codes[before]
            fraction = np.clip((codes - self.codes[before]) / span, 0.0, 1.0)
        blend = fraction[:, None]
        rotations = slerp(self.rotations[before], self.rotations[after], fraction)
        scales = (1 - blend) * self.scales[before] + blend * self.scales[after]
        result = np.zeros((len(codes), 4, 4))
        result[:, :3, :3] = rotation_matrices(rotations) * scales[:, None, :]
        result[:, :3, 3] = (1 - blend) * self.translations[before] + blend * self.translations[after]
        result[:, 3, 3] = 1.0
        return result

    def refined(self) -> Track:
        """The same motion with keys at whole codes where it turns too far to be interpolated per component."""
        cosines = np.abs(np.einsum("ij,ij->i", self.rotations[1:], self.rotations[:-1]))
        wide = np.flatnonzero(2 * np.arccos(np.clip(cosines, 0, 1)) > MAX_TURN)
        extra = [np.arange(np.floor(self.codes[k]) + 1, self.codes[k + 1]) for k in wide]
        if not any(len(codes) for codes in extra):
            return self
        codes = np.unique(np.concatenate([self.codes, *extra]))
        return from_matrices(codes, self.matrices(codes))


STILL = Track(np.zeros(1), np.zeros((1, 3)), np.array([[1.0, 0, 0, 0]]), np.ones((1, 3)))
"""The frame itself."""


def rotation_matrices(quaternions: np.ndarray) -> np.ndarray:
    """Unit quaternions [N, 4] as column-vector rotation matrices [N, 3, 3]."""
    w, x, y, z = np.asarray(quaternions, dtype=np.float64).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, -1) for row in rows], -2)


def quaternions_from_matrices(matrices: np.ndarray) -> np.ndarray:
    """Rotation matrices [N, 3, 3] as unit quaternions [N, 4], one hemisphere along the array."""
    m = np.asarray(matrices, dtype=np.float64)
    xx, yy, zz = m[:, 0, 0], m[:, 1, 1], m[:, 2, 2]
    # Four times each squared component; the largest one divides (Shepperd's method).
    squares = np.stack([1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz], -1)
    a, b, c = m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]
    d, e, f = m[:, 1, 0] + m[:, 0, 1], m[:, 0, 2] + m[:, 2, 0], m[:, 2, 1] + m[:, 1, 2]
    products = np.stack(
        [
            np.stack([squares[:, 0], a, b, c], -1),
            np.stack([a, squares[:, 1], d, e], -1),
            np.stack([b, d, squares[:, 2], f], -1),
            np.stack([c, e, f, squares[:, 3]], -1),
        ],
        -2,
    )
    best = squares.argmax(-1)
    quaternions = products[np.arange(len(m)), best]
    quaternions /= np.linalg.norm(quaternions, axis=-1, keepdims=True)
    return one_hemisphere(quaternions)


def one_hemisphere(quaternions: np.ndarray) -> np.ndarray:
    """Quaternions [T, 4] with signs such that neighbours are close; the first one has w >= 0."""
    signs = np.ones(len(quaternions))
    if len(quaternions):
        signs[0] = -1.0 if quaternions[0, 0] < 0 else 1.0
        steps = np.einsum("ij,ij->i", quaternions[1:], quaternions[:-1])
        signs[1:] = signs[0] * np.cumprod(np.where(steps < 0, -1.0, 1.0))
    return quaternions * signs[:, None]


def slerp(a: np.ndarray, b: np.ndarray, fraction: np.ndarray) -> np.ndarray:
    """Spherical interpolation of unit quaternions [N, 4] by fractions [N], the short way round."""
    cosines = np.einsum("ij,ij->i", a, b)
    b = np.where(cosines[:, None] < 0, -b, b)
    angles = np.arccos(np.clip(np.abs(cosines), 0.0, 1.0))
    sines = np.sin(angles)
    narrow = sines < 1e-6
    safe = np.where(narrow, 1.0, sines)
    weight_a = np.where(narrow, 1 - fraction, np.sin((1 - fraction) * angles) / safe)
    weight_b = np.where(narrow, fraction, np.sin(fraction * angles) / safe)
    result = weight_a[:, None] * a + weight_b[:, None] * b
    return result / np.linalg.norm(result, axis=-1, keepdims=True)


def from_matrices(codes: np.ndarray, matrices: np.ndarray) -> Track:
    """The track through column-vector matrices [T, 4, 4]; shear, which `shear` measures, is left out."""
    linear = np.asarray(matrices, dtype=np.float64)[:, :3, :3]
    scales = np.linalg.norm(linear, axis=1)
    scales[:, 0] *= np.where(np.linalg.det(linear) < 0, -1.0, 1.0)
    safe = np.where(np.abs(scales) < 1e-300, 1.0, scales)
    # The nearest rotation: exact where the axes are orthogonal.
    u, _, v = np.linalg.svd(linear / safe[:, None, :])
    u[:, :, -1] *= np.linalg.det(u @ v)[:, None]
    return Track(
        np.asarray(codes, dtype=np.float64),
        np.asarray(matrices, dtype=np.float64)[:, :3, 3].copy(),
        quaternions_from_matrices(u @ v),
        scales,
    )


def shear(matrices: np.ndarray) -> float:
    """Largest cosine between two axes of the matrices [T, 4, 4]; 0 where all are free of shear."""
    linear = np.asarray(matrices, dtype=np.float64)[:, :3, :3]
    norms = np.linalg.norm(linear, axis=1, keepdims=True)
    axes = linear / np.where(norms < 1e-300, 1.0, norms)
    cosines = np.einsum("nki,nkj->nij", axes, axes)
    return float(np.abs(cosines[:, [0, 0, 1], [1, 2, 2]]).max(initial=0.0))


def thinned(track: Track, tolerance: float = 1e-6) -> Track:
    """The track with only the keys that interpolation needs: matrix entries change by less than `tolerance`."""
    matrices = track.matrices(track.codes)
    if np.abs(matrices - matrices[:1]).max() <= tolerance:
        return Track(track.codes[:1], track.translations[:1], track.rotations[:1], track.scales[:1])
    kept = [0]
    last = len(track.codes) - 1
    while kept[-1] < last:
        start, reach = kept[-1], kept[-1] + 1
        # Doubling steps, then bisection, so that long straight stretches stay cheap.
        step = 1
        while reach + step <= last and _spans(track, matrices, start, reach + step, tolerance):
            reach, step = reach + step, step * 2
        while step > 1:
            step //= 2
            if reach + step <= last and _spans(track, matrices, start, reach + step, tolerance):
                reach += step
        kept.append(reach)
    return Track(track.codes[kept], track.translations[kept], track.rotations[kept], track.scales[kept])


def _spans(track: Track, matrices: np.ndarray, start: int, stop: int, tolerance: float) -> bool:
    ends = [start, stop]
    chord = Track(track.codes[ends], track.translations[ends], track.rotations[ends], track.scales[ends])
    between = slice(start, stop + 1)
    return bool(np.abs(chord.matrices(track.codes[between]) - matrices[between]).max() <= tolerance)
