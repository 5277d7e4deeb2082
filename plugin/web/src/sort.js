// Depth order of splats, far to near.

/** Opacity below which nothing is drawn: one step of an 8-bit image. */
export const MIN_ALPHA = Math.fround(1 / 255);

const DIGIT_BITS = 11;
const DIGITS = 1 << DIGIT_BITS;
const DIGIT_MASK = DIGITS - 1;

/**
 * Splats that share a frame, as a camera sees them.
 * @typedef {object} SortedRange
 * @property {number} first First splat.
 * @property {number} count Number of splats.
 * @property {boolean} shown False when they are left out.
 * @property {Float64Array} rows `camera_from_local`: three rows of four.
 * @property {Float64Array} centre Camera centre, local frame.
 */

/** Sorts splats; its buffers are kept from one call to the next. */
export class DepthOrder {
  /**
   * @param {number} count Number of splats.
   * @param {number} row The order is padded to whole rows of so many splats.
   */
  constructor(count, row) {
    this.keys = new Float32Array(count);
    this.bits = new Uint32Array(this.keys.buffer);
    this.otherBits = new Uint32Array(count);
    this.indices = new Uint32Array(count);
    this.otherIndices = new Uint32Array(count);
    this.histogram = new Uint32Array(3 * DIGITS);
    /** Splats far to near: the first `drawn` entries count. Equal keys: the smaller index is in front. */
    this.order = new Uint32Array(row * Math.max(1, Math.ceil(count / row)));
    /** Number of splats that are drawn. */
    this.drawn = 0;
  }

  /**
   * @param {SortedRange[]} ranges
   * @param {Float32Array} centres x, y, z, opacity of every splat, local frame.
   * @param {number} near Near plane.
   * @param {boolean} byDistance By distance to the camera centre instead of z.
   */
  update(ranges, centres, near, byDistance) {
    let count = 0;
    for (const range of ranges) {
      if (range.shown) count = this.collect(range, centres, near, byDistance, count);
    }
    this.drawn = count;
    this.sort(count);
  }

  /**
   * Appends the splats of a range that can be seen, and returns the number of splats after that.
   * @param {SortedRange} range
   * @param {Float32Array} centres
   * @param {number} near
   * @param {boolean} byDistance
   * @param {number} count
   * @returns {number}
   */
  collect(range, centres, near, byDistance, count) {
    const { keys, indices } = this;
    const [m0, m1, m2, m3] = range.rows.subarray(8);
    const [c0, c1, c2] = range.centre;
    const end = range.first + range.count;
    for (let splat = range.first, at = 4 * splat; splat < end; splat++, at += 4) {
      const x = centres[at];
      const y = centres[at + 1];
      const z = centres[at + 2];
      const depth = m0 * x + m1 * y + m2 * z + m3;
      // Written so that values that are no numbers are left out.
      if (!(depth >= near && depth < 3e38 && centres[at + 3] >= MIN_ALPHA)) continue;
      keys[count] = byDistance ? Math.sqrt((x - c0) ** 2 + (y - c1) ** 2 + (z - c2) ** 2) : depth;
      indices[count++] = splat;
    }
    return count;
  }

  /**
   * Three stable passes from the lowest digit on. Bits of positive floats ascend as the floats do; the last
   * pass writes from the end on, so that the order is far to near and ties end with the smaller index.
   * @param {number} count
   */
  sort(count) {
    const { histogram, bits, otherBits, indices, otherIndices, order } = this;
    histogram.fill(0);
    for (let i = 0; i < count; i++) {
      const key = bits[i];
      histogram[key & DIGIT_MASK]++;
      histogram[DIGITS + ((key >>> DIGIT_BITS) & DIGIT_MASK)]++;
      histogram[2 * DIGITS + (key >>> (2 * DIGIT_BITS))]++;
    }
    for (let pass = 0; pass < 3; pass++) {
      let sum = 0;
      for (let digit = pass * DIGITS; digit < (pass + 1) * DIGITS; digit++) {
        const size = histogram[digit];
        histogram[digit] = sum;
        sum += size;
      }
    }
    for (let i = 0; i < count; i++) {
      const to = histogram[bits[i] & DIGIT_MASK]++;
      otherBits[to] = bits[i];
      otherIndices[to] = indices[i];
    }
    for (let i = 0; i < count; i++) {
      const to = histogram[DIGITS + ((otherBits[i] >>> DIGIT_BITS) & DIGIT_MASK)]++;
      bits[to] = otherBits[i];
      indices[to] = otherIndices[i];
    }
    for (let i = 0; i < count; i++) {
      const to = histogram[2 * DIGITS + (bits[i] >>> (2 * DIGIT_BITS))]++;
      order[count - 1 - to] = indices[i];
    }
  }
}
