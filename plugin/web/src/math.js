// Quaternions (w, x, y, z) and poses [x, y, z, qw, qx, qy, qz]. A pose `a_from_b` takes points of frame b to
// frame a.

/** @typedef {import('./types.js').Pose} Pose */

/**
 * Hamilton product: the rotation `b` first, then `a`.
 * @param {ArrayLike<number>} a
 * @param {ArrayLike<number>} b
 * @returns {number[]}
 */
export function multiplyQuaternions(a, b) {
  return [
    a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
    a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
    a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
    a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
  ];
}

/**
 * The inverse of a unit quaternion.
 * @param {ArrayLike<number>} q
 * @returns {number[]}
 */
export function conjugate(q) {
  return [q[0], -q[1], -q[2], -q[3]];
}

/**
 * The unit quaternion along `q`; the identity when `q` is zero.
 * @param {ArrayLike<number>} q
 * @returns {number[]}
 */
export function normalizeQuaternion(q) {
  const norm = Math.hypot(q[0], q[1], q[2], q[3]);
  return norm > 0 ? [q[0] / norm, q[1] / norm, q[2] / norm, q[3] / norm] : [1, 0, 0, 0];
}

/**
 * A vector turned by a unit quaternion.
 * @param {ArrayLike<number>} q
 * @param {ArrayLike<number>} v
 * @returns {number[]}
 */
export function rotate(q, v) {
  const m = toRotation(q);
  return [
    m[0] * v[0] + m[1] * v[1] + m[2] * v[2],
    m[3] * v[0] + m[4] * v[1] + m[5] * v[2],
    m[6] * v[0] + m[7] * v[1] + m[8] * v[2],
  ];
}

/**
 * Rotation matrix of a unit quaternion, row by row.
 * @param {ArrayLike<number>} q
 * @returns {number[]}
 */
export function toRotation(q) {
  const w = q[0];
  const x = q[1];
  const y = q[2];
  const z = q[3];
  return [
    1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
    2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
    2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
  ];
}

/**
 * Unit quaternion of a rotation matrix, row by row.
 * @param {ArrayLike<number>} m
 * @returns {number[]}
 */
export function fromRotation(m) {
  const squares = [
    1 + m[0] + m[4] + m[8],
    1 + m[0] - m[4] - m[8],
    1 - m[0] + m[4] - m[8],
    1 - m[0] - m[4] + m[8],
  ];
  const largest = squares.indexOf(Math.max(...squares));
  const differences = [m[7] - m[5], m[2] - m[6], m[3] - m[1]];
  if (largest === 0) return normalizeQuaternion([squares[0], ...differences]);
  const sums = [m[1] + m[3], m[2] + m[6], m[5] + m[7]];
  const rows = [
    [differences[0], squares[1], sums[0], sums[1]],
    [differences[1], sums[0], squares[2], sums[2]],
    [differences[2], sums[1], sums[2], squares[3]],
  ];
  return normalizeQuaternion(rows[largest - 1]);
}

/**
 * Spherical interpolation between unit quaternions, the short way.
 * @param {ArrayLike<number>} a
 * @param {ArrayLike<number>} b
 * @param {number} fraction
 * @returns {number[]}
 */
export function slerp(a, b, fraction) {
  const cosine = a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3];
  const sign = cosine < 0 ? -1 : 1;
  const angle = Math.acos(Math.min(1, Math.abs(cosine)));
  const sine = Math.sin(angle);
  const nearlyEqual = sine < 1e-9;
  const from = nearlyEqual ? 1 - fraction : Math.sin((1 - fraction) * angle) / sine;
  const to = sign * (nearlyEqual ? fraction : Math.sin(fraction * angle) / sine);
  return normalizeQuaternion([
    from * a[0] + to * b[0],
    from * a[1] + to * b[1],
    from * a[2] + to * b[2],
    from * a[3] + to * b[3],
  ]);
}

/**
 * The quaternion of a pose.
 * @param {Pose} pose
 * @returns {number[]}
 */
export function turnOf(pose) {
  return [pose[3], pose[4], pose[5], pose[6]];
}

/**
 * A point taken through a pose.
 * @param {Pose} pose
 * @param {ArrayLike<number>} point
 * @returns {number[]}
 */
export function transformPoint(pose, point) {
  const turned = rotate(turnOf(pose), point);
  return [turned[0] + pose[0], turned[1] + pose[1], turned[2] + pose[2]];
}

/**
 * `a_from_c` of `a_from_b` and `b_from_c`.
 * @param {Pose} a
 * @param {Pose} b
 * @returns {number[]}
 */
export function compose(a, b) {
  return [...transformPoint(a, [b[0], b[1], b[2]]), ...multiplyQuaternions(turnOf(a), turnOf(b))];
}

/**
 * `b_from_a` of `a_from_b`.
 * @param {Pose} pose
 * @returns {number[]}
 */
export function inverse(pose) {
  const back = conjugate(turnOf(pose));
  return [...rotate(back, [-pose[0], -pose[1], -pose[2]]), ...back];
}
