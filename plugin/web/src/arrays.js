// Stored arrays of the block of bytes, decoded to single precision.

/** @typedef {import('./types.js').Stored} Stored */

/** Reads ranges of a stored array. */
export class StoredReader {
  /**
   * @param {ArrayBuffer} bytes
   * @param {Stored} stored
   */
  constructor(bytes, stored) {
    this.length = stored.length;
    this.scale = stored.scale;
    this.isUpperHalf = stored.kind === 'bf16';
    /** @type {Float32Array | Uint16Array | Int16Array | Int8Array} */
    this.values = storedView(bytes, stored);
  }

  /**
   * Writes `count` values from the one at `start` on to `target`, whose length it does not exceed.
   * @param {number} start
   * @param {number} count
   * @param {Float32Array} target
   */
  read(start, count, target) {
    const { values, scale } = this;
    if (this.isUpperHalf) {
      const bits = new Uint32Array(target.buffer, target.byteOffset, count);
      for (let i = 0; i < count; i++) bits[i] = values[start + i] << 16;
      if (scale !== 1) for (let i = 0; i < count; i++) target[i] *= scale;
    } else {
      for (let i = 0; i < count; i++) target[i] = values[start + i] * scale;
    }
  }
}

/**
 * The stored numbers themselves; `bf16` as the upper halves.
 * @param {ArrayBuffer} bytes
 * @param {Stored} stored
 * @returns {Float32Array | Uint16Array | Int16Array | Int8Array}
 */
function storedView(bytes, { at, length, kind }) {
  const width = kind === 'f32' ? 4 : kind === 'i8' ? 1 : 2;
  if (at + length * width > bytes.byteLength) {
    throw new Error('The data of the scene are incomplete. Load the page again.');
  }
  switch (kind) {
    case 'f32': return new Float32Array(bytes, at, length);
    case 'bf16': return new Uint16Array(bytes, at, length);
    case 'i16': return new Int16Array(bytes, at, length);
    case 'i8': return new Int8Array(bytes, at, length);
    default: throw new Error(`The scene has numbers of an unknown kind, ${kind}.`);
  }
}

/**
 * All values of a stored array.
 * @param {ArrayBuffer} bytes
 * @param {Stored} stored
 * @returns {Float32Array}
 */
export function decodeArray(bytes, stored) {
  const values = new Float32Array(stored.length);
  new StoredReader(bytes, stored).read(0, stored.length, values);
  return values;
}
