// Where splats are at a time code, how opaque they are, and which of them can be seen.

import { StoredReader, decodeArray } from './arrays.js';
import { compose, inverse, normalizeQuaternion, slerp, toRotation, turnOf } from './math.js';

/** @typedef {import('./types.js').Document} Document */
/** @typedef {import('./types.js').Node} Node */
/** @typedef {import('./types.js').Pose} Pose */
/** @typedef {import('./types.js').Stored} Stored */
/** @typedef {import('./types.js').Track} Track */
/** @typedef {import('./types.js').Visibility} Visibility */

/**
 * Number of ascending codes that are at most `code`.
 * @param {ArrayLike<number>} codes
 * @param {number} code
 * @returns {number}
 */
export function countUpTo(codes, code) {
  let low = 0;
  let high = codes.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (codes[middle] <= code) low = middle + 1;
    else high = middle;
  }
  return low;
}

/**
 * Samples before and after a code, and how far it is between them; the nearest sample twice outside them.
 * @param {ArrayLike<number>} codes At least one.
 * @param {number} code
 * @returns {{ before: number, after: number, fraction: number }}
 */
export function samplesAround(codes, code) {
  const count = countUpTo(codes, code);
  const before = Math.max(count, 1) - 1;
  const after = Math.min(count, codes.length - 1);
  const span = codes[after] - codes[before];
  return { before, after, fraction: span > 0 ? (code - codes[before]) / span : 0 };
}

/**
 * Pose of a track at a time code; the identity without samples.
 * @param {Track} track
 * @param {number} code
 * @returns {number[]}
 */
export function poseAt(track, code) {
  if (track.codes.length === 0) return [0, 0, 0, 1, 0, 0, 0];
  const { before, after, fraction } = samplesAround(track.codes, code);
  const a = track.poses[before];
  const b = track.poses[after];
  const mix = (/** @type {number} */ axis) => a[axis] + fraction * (b[axis] - a[axis]);
  const turn = before === after ? normalizeQuaternion(turnOf(a)) : slerp(turnOf(a), turnOf(b), fraction);
  return [mix(0), mix(1), mix(2), ...turn];
}

/**
 * `world_from_part` at a time code.
 * @param {Node} node
 * @param {number} part
 * @param {number} code
 * @returns {number[]}
 */
export function partPoseAt(node, part, code) {
  return compose(poseAt(node.track, code), poseAt(node.parts[part].track, code));
}

/**
 * True when changes of visibility leave something visible at a time code; before the first one it counts.
 * @param {Visibility[]} changes
 * @param {number} code
 * @returns {boolean}
 */
export function isVisibleAt(changes, code) {
  if (changes.length === 0) return true;
  const count = countUpTo(changes.map((change) => change.code), code);
  return changes[Math.max(count, 1) - 1].visible;
}

/** Rows of a stored array of samples: the two around a time code are kept decoded. */
export class SampledRows {
  /**
   * @param {ArrayBuffer} bytes
   * @param {number[]} codes
   * @param {Stored} stored
   */
  constructor(bytes, codes, stored) {
    this.codes = codes;
    this.reader = new StoredReader(bytes, stored);
    this.width = codes.length > 0 ? stored.length / codes.length : 0;
    /** Values of the sample before the code. */
    this.a = new Float32Array(this.width);
    /** Values of the sample after the code. */
    this.b = new Float32Array(this.width);
    /** How far the code is between them. */
    this.fraction = 0;
    this.sampleOfA = -1;
    this.sampleOfB = -1;
  }

  /**
   * Goes to a time code; false when the values stay as they were.
   * @param {number} code
   * @returns {boolean}
   */
  seek(code) {
    if (this.width === 0) return false;
    const { before, after, fraction } = samplesAround(this.codes, code);
    if (before === this.sampleOfA && after === this.sampleOfB && fraction === this.fraction) return false;
    if (before === this.sampleOfB || after === this.sampleOfA) {
      [this.a, this.b] = [this.b, this.a];
      [this.sampleOfA, this.sampleOfB] = [this.sampleOfB, this.sampleOfA];
    }
    if (before !== this.sampleOfA) this.reader.read(before * this.width, this.width, this.a);
    if (after !== this.sampleOfB) this.reader.read(after * this.width, this.width, this.b);
    this.sampleOfA = before;
    this.sampleOfB = after;
    this.fraction = fraction;
    return true;
  }
}

/**
 * Writes moved centres, `resting + offset`, to every fourth value of `target` from `at` on.
 * @param {Float32Array} resting
 * @param {SampledRows} offsets
 * @param {Float32Array} target
 * @param {number} at
 */
export function writeMovedCentres(resting, { a, b, fraction }, target, at) {
  for (let i = 0, to = at; i < a.length; i += 3, to += 4) {
    target[to] = resting[i] + a[i] + fraction * (b[i] - a[i]);
    target[to + 1] = resting[i + 1] + a[i + 1] + fraction * (b[i + 1] - a[i + 1]);
    target[to + 2] = resting[i + 2] + a[i + 2] + fraction * (b[i + 2] - a[i + 2]);
  }
}

/**
 * Writes quaternions mixed the short way and normalised to `target` from `at` on.
 * @param {SampledRows} orientations
 * @param {Float32Array} target
 * @param {number} at
 */
export function writeMixedTurns({ a, b, fraction }, target, at) {
  for (let i = 0; i < a.length; i += 4) {
    const cosine = a[i] * b[i] + a[i + 1] * b[i + 1] + a[i + 2] * b[i + 2] + a[i + 3] * b[i + 3];
    const from = 1 - fraction;
    const to = cosine < 0 ? -fraction : fraction;
    const w = from * a[i] + to * b[i];
    const x = from * a[i + 1] + to * b[i + 1];
    const y = from * a[i + 2] + to * b[i + 2];
    const z = from * a[i + 3] + to * b[i + 3];
    const norm = Math.sqrt(w * w + x * x + y * y + z * z);
    const useMixed = norm >= 1e-6;
    const scale = useMixed ? 1 / norm : 1;
    target[at + i] = (useMixed ? w : a[i]) * scale;
    target[at + i + 1] = (useMixed ? x : a[i + 1]) * scale;
    target[at + i + 2] = (useMixed ? y : a[i + 2]) * scale;
    target[at + i + 3] = (useMixed ? z : a[i + 3]) * scale;
  }
}

/**
 * Writes groups of `size` mixed values to groups of four of `target` from `at` on.
 * @param {SampledRows} rows
 * @param {number} size
 * @param {Float32Array} target
 * @param {number} at
 */
export function writeMixed({ a, b, fraction }, size, target, at) {
  for (let i = 0, to = at; i < a.length; i += size, to += 4) {
    for (let k = 0; k < size; k++) target[to + k] = a[i + k] + fraction * (b[i + k] - a[i + k]);
  }
}

/** Splats that share a frame: those of a part, or those of a node that no part has. */
export class SplatRange {
  /**
   * @param {number} node
   * @param {number} part Index of the part, or -1.
   * @param {number} first First splat of the scene.
   * @param {number} count
   */
  constructor(node, part, first, count) {
    this.node = node;
    this.part = part;
    this.first = first;
    this.count = count;
    /** True when its node can be seen. */
    this.shown = true;
    /** `world_from_local` at the time. @type {number[]} */
    this.pose = [0, 0, 0, 1, 0, 0, 0];
    /** `camera_from_local`: three rows of four. */
    this.rows = new Float64Array(12);
    /** Camera centre, local frame. */
    this.centre = new Float64Array(3);
  }

  /**
   * Looks at the range from a camera.
   * @param {Pose} cameraFromWorld
   */
  setCamera(cameraFromWorld) {
    const pose = compose(cameraFromWorld, this.pose);
    const m = toRotation(turnOf(pose));
    for (let row = 0; row < 3; row++) {
      this.rows.set([m[3 * row], m[3 * row + 1], m[3 * row + 2], pose[row]], 4 * row);
    }
    const back = inverse(pose);
    this.centre.set([back[0], back[1], back[2]]);
  }
}

/**
 * The ranges of a node, in the order of its splats.
 * @param {Node} node
 * @param {number} index
 * @param {number} first
 * @returns {SplatRange[]}
 */
function rangesOf(node, index, first) {
  const ranges = [];
  let done = 0;
  const parts = node.parts.map((part, k) => ({ k, start: part.first, end: part.first + part.count }));
  for (const { k, start, end } of parts.sort((a, b) => a.start - b.start)) {
    if (start > done) ranges.push(new SplatRange(index, -1, first + done, start - done));
    if (end > start) ranges.push(new SplatRange(index, k, first + start, end - start));
    done = Math.max(done, end);
  }
  const { count } = node.splats;
  if (count > done) ranges.push(new SplatRange(index, -1, first + done, count - done));
  return ranges;
}

/** What of a node changes over time apart from its pose. */
class NodeMotion {
  /**
   * @param {Node} node
   * @param {ArrayBuffer} bytes
   */
  constructor(node, bytes) {
    const sampled = (/** @type {number[]} */ codes, /** @type {Stored | null} */ stored) =>
      (stored && codes.length > 0 ? new SampledRows(bytes, codes, stored) : null);
    const { deformation, opacities, harmonics } = node;
    this.offsets = deformation && sampled(deformation.codes, deformation.offsets);
    this.turns = deformation && sampled(deformation.codes, deformation.orientations);
    this.scales = deformation && sampled(deformation.codes, deformation.scales);
    this.opacities = opacities && sampled(opacities.codes, opacities.values);
    this.harmonics = harmonics && sampled(harmonics.codes, harmonics.values);
    this.resting = this.offsets && decodeArray(bytes, node.splats.centres);
  }
}

/**
 * Splats of a node whose values changed.
 * @typedef {object} SplatChange
 * @property {number} node
 * @property {boolean} centres Centres or opacities.
 * @property {boolean} turns Orientations.
 * @property {boolean} sizes Scales.
 * @property {boolean} harmonics Coefficients.
 */

/** All splats of a document at a time code, in arrays of four values per splat. */
export class SplatPlacement {
  /**
   * @param {Document} document
   * @param {ArrayBuffer} bytes
   * @param {number} row Values are padded to whole rows of so many splats.
   */
  constructor(document, bytes, row) {
    this.document = document;
    this.bytes = bytes;
    /** First splat of every node. @type {number[]} */
    this.firsts = [];
    /** @type {SplatRange[]} */
    this.ranges = [];
    /** True for the nodes that can be seen at the time. */
    this.visible = document.nodes.map(() => true);
    /** Number of splats. */
    this.count = 0;
    for (const [index, node] of document.nodes.entries()) {
      this.firsts.push(this.count);
      this.ranges.push(...rangesOf(node, index, this.count));
      this.count += node.splats.count;
    }
    const length = 4 * row * Math.max(1, Math.ceil(this.count / row));
    /** x, y, z, opacity. */
    this.centres = new Float32Array(length);
    /** Quaternions w, x, y, z. */
    this.turns = new Float32Array(length);
    /** Standard deviations, and the index of the range. */
    this.sizes = new Float32Array(length);
    this.motions = document.nodes.map((node) => new NodeMotion(node, bytes));
    /** Splats that were erased, by node. @type {Map<number, Set<number>>} */
    this.erased = new Map();
    for (const [index, node] of document.nodes.entries()) this.rest(node, this.firsts[index]);
    for (const [index, range] of this.ranges.entries()) {
      const end = range.first + range.count;
      for (let splat = range.first; splat < end; splat++) this.sizes[4 * splat + 3] = index;
    }
  }

  /**
   * Writes the splats of a node at rest.
   * @param {Node} node
   * @param {number} first
   */
  rest({ splats }, first) {
    const centres = decodeArray(this.bytes, splats.centres);
    const opacities = decodeArray(this.bytes, splats.opacities);
    const scales = decodeArray(this.bytes, splats.scales);
    this.turns.set(decodeArray(this.bytes, splats.orientations), 4 * first);
    for (let splat = 0, to = 4 * first; splat < splats.count; splat++, to += 4) {
      for (let axis = 0; axis < 3; axis++) {
        this.centres[to + axis] = centres[3 * splat + axis];
        this.sizes[to + axis] = scales[3 * splat + axis];
      }
      this.centres[to + 3] = opacities[splat];
    }
  }

  /**
   * Goes to a time code. The changes name what has to be uploaded; `moved` is true when anything else than
   * colours changed, poses and visibility included.
   * @param {number} code
   * @returns {{ changes: SplatChange[], moved: boolean }}
   */
  setTime(code) {
    const nodes = this.document.nodes;
    /** @type {SplatChange[]} */
    const changes = [];
    let moved = false;
    for (const [node, { visibility }] of nodes.entries()) {
      const visible = isVisibleAt(visibility, code);
      moved ||= visible !== this.visible[node];
      this.visible[node] = visible;
      const change = this.deform(node, code);
      if (change) changes.push(change);
      moved ||= change !== null && (change.centres || change.turns || change.sizes);
    }
    for (const range of this.ranges) {
      const node = nodes[range.node];
      const pose = range.part < 0 ? poseAt(node.track, code) : partPoseAt(node, range.part, code);
      moved ||= pose.some((value, k) => value !== range.pose[k]);
      range.pose = pose;
    }
    return { changes, moved };
  }

  /**
   * Erases splats of a node in place of those that were erased before.
   * @param {number} node
   * @param {Set<number>} splats Places among the splats of the node.
   */
  erase(node, splats) {
    const first = this.firsts[node];
    const { opacities } = this.motions[node];
    if (opacities) {
      writeMixed(opacities, 1, this.centres.subarray(3), 4 * first);
    } else {
      const resting = decodeArray(this.bytes, this.document.nodes[node].splats.opacities);
      for (const splat of this.erased.get(node) ?? []) this.centres[4 * (first + splat) + 3] = resting[splat];
    }
    this.erased.set(node, splats);
    this.clearErased(node);
  }

  /** @param {number} node */
  clearErased(node) {
    const first = this.firsts[node];
    for (const splat of this.erased.get(node) ?? []) this.centres[4 * (first + splat) + 3] = 0;
  }

  /**
   * Writes the splats of a node at a time code; null when nothing changed.
   * @param {number} node
   * @param {number} code
   * @returns {SplatChange | null}
   */
  deform(node, code) {
    const { offsets, turns, scales, opacities, harmonics, resting } = this.motions[node];
    const at = 4 * this.firsts[node];
    const change = { node, centres: false, turns: false, sizes: false, harmonics: false };
    if (offsets && resting && offsets.seek(code)) {
      writeMovedCentres(resting, offsets, this.centres, at);
      change.centres = true;
    }
    if (turns && turns.seek(code)) {
      writeMixedTurns(turns, this.turns, at);
      change.turns = true;
    }
    if (scales && scales.seek(code)) {
      writeMixed(scales, 3, this.sizes, at);
      change.sizes = true;
    }
    if (opacities && opacities.seek(code)) {
      writeMixed(opacities, 1, this.centres.subarray(3), at);
      change.centres = true;
    }
    if (change.centres) this.clearErased(node);
    change.harmonics = harmonics !== null && harmonics.seek(code);
    return change.centres || change.turns || change.sizes || change.harmonics ? change : null;
  }
}

/** Coefficients of the splats of a node as texels of four values: `(degree + 1)^2` colours, padded. */
export class HarmonicsPacker {
  /**
   * @param {Node} node
   * @param {ArrayBuffer} bytes
   * @param {SampledRows | null} samples Coefficients over time; null where they stay.
   */
  constructor(node, bytes, samples) {
    const { degree, base, higher } = node.splats;
    /** Values per splat. */
    this.values = 3 * (degree + 1) ** 2;
    this.samples = samples;
    this.base = samples ? null : new StoredReader(bytes, base);
    this.higher = samples || !higher || degree === 0 ? null : new StoredReader(bytes, higher);
  }

  /**
   * Writes the coefficients of a range of the node's splats to `target`.
   * @param {number} start
   * @param {number} count
   * @param {Float32Array} target
   */
  pack(start, count, target) {
    const { values, samples } = this;
    const stride = 4 * harmonicsTexels(values);
    if (samples) {
      const { a, b, fraction } = samples;
      for (let splat = 0; splat < count; splat++) {
        const from = (start + splat) * values;
        const to = splat * stride;
        for (let k = 0; k < values; k++) {
          target[to + k] = a[from + k] + fraction * (b[from + k] - a[from + k]);
        }
      }
      return;
    }
    if (this.base) spreadValues(this.base, start, count, 3, target, 0, stride);
    if (this.higher) spreadValues(this.higher, start, count, values - 3, target, 3, stride);
  }
}

/**
 * Texels of four values that so many values take.
 * @param {number} values
 * @returns {number}
 */
export function harmonicsTexels(values) {
  return Math.ceil(values / 4);
}

/**
 * Copies groups of `size` stored values to `target`, `stride` apart from `at` on.
 * @param {StoredReader} reader
 * @param {number} start First group.
 * @param {number} count Number of groups.
 * @param {number} size
 * @param {Float32Array} target
 * @param {number} at
 * @param {number} stride
 */
function spreadValues(reader, start, count, size, target, at, stride) {
  const values = new Float32Array(count * size);
  reader.read(start * size, count * size, values);
  for (let group = 0; group < count; group++) {
    for (let k = 0; k < size; k++) target[at + group * stride + k] = values[group * size + k];
  }
}
