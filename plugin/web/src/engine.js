// Draws a document of animated splats to a canvas.

import { decodeArray } from './arrays.js';
import { inverse, normalizeQuaternion, toRotation, transformPoint, turnOf } from './math.js';
import { HarmonicsPacker, SplatPlacement, harmonicsTexels } from './motion.js';
import { isVisibleAt, partPoseAt, poseAt } from './motion.js';
import { COMPOSE_FRAGMENT, COVER_VERTEX, PROJECT_FRAGMENT, SPLAT_FRAGMENT, SPLAT_VERTEX } from './shaders.js';
import { RANGES_PER_ROW, SPLATS_PER_INSTANCE, SPLATS_PER_ROW, TABLE_TEXELS } from './shaders.js';
import { buildProgram } from './shaders.js';
import { DepthOrder, MIN_ALPHA } from './sort.js';

/** @typedef {import('./types.js').Camera} Camera */
/** @typedef {import('./types.js').Document} Document */
/** @typedef {import('./types.js').Look} Look */
/** @typedef {import('./types.js').Node} Node */
/** @typedef {import('./types.js').Picked} Picked */
/** @typedef {import('./types.js').Shot} Shot */
/** @typedef {import('./motion.js').SplatChange} SplatChange */
/** @typedef {import('./motion.js').SplatRange} SplatRange */
/** @typedef {import('./shaders.js').ShaderProgram} ShaderProgram */

/** Version of the document that the engine reads. */
export const DOCUMENT_VERSION = 1;

/** Near plane of documents that name none, world units. */
export const DEFAULT_NEAR = 0.2;

const MAX_ALPHA = 0.99;
const MIN_TRANSMITTANCE = 1e-4;
const HARMONICS_CHUNK = 16384;
const MODES = { color: 0, instances: 1, depth: 2 };

/**
 * A texture without filtering.
 * @param {WebGL2RenderingContext} gl
 * @param {number} format Sized internal format.
 * @param {number} width
 * @param {number} height
 * @returns {WebGLTexture}
 */
function createTexture(gl, format, width, height) {
  const texture = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.texStorage2D(gl.TEXTURE_2D, 1, format, width, height);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
  return texture;
}

/**
 * A framebuffer that draws to textures.
 * @param {WebGL2RenderingContext} gl
 * @param {WebGLTexture[]} textures
 * @returns {WebGLFramebuffer}
 */
function createFramebuffer(gl, textures) {
  const framebuffer = gl.createFramebuffer();
  gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
  for (const [index, texture] of textures.entries()) {
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + index, gl.TEXTURE_2D, texture, 0);
  }
  gl.drawBuffers(textures.map((_, index) => gl.COLOR_ATTACHMENT0 + index));
  return framebuffer;
}

/**
 * Binds textures to units from 0 on, under the names of their samplers.
 * @param {WebGL2RenderingContext} gl
 * @param {ShaderProgram} program
 * @param {Record<string, WebGLTexture>} textures
 */
function bindTextures(gl, { uniforms }, textures) {
  for (const [unit, [name, texture]] of Object.entries(textures).entries()) {
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.uniform1i(uniforms[name], unit);
  }
  gl.activeTexture(gl.TEXTURE0);
}

/**
 * Writes a run of texels, of four floats each, that goes on from row to row.
 * @param {WebGL2RenderingContext} gl
 * @param {number} width Of the texture.
 * @param {number} start First texel.
 * @param {number} count Number of texels.
 * @param {Float32Array} values
 */
function writeTexels(gl, width, start, count, values) {
  let done = 0;
  while (done < count) {
    const x = (start + done) % width;
    const y = Math.floor((start + done) / width);
    const rows = x > 0 ? 0 : Math.floor((count - done) / width);
    const columns = rows > 0 ? width : Math.min(width - x, count - done);
    const height = Math.max(rows, 1);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, x, y, columns, height, gl.RGBA, gl.FLOAT, values, 4 * done);
    done += columns * height;
  }
}

/**
 * Corners of quads, two triangles each.
 * @param {number} count
 * @returns {Uint16Array<ArrayBuffer>}
 */
function quadIndices(count) {
  const indices = new Uint16Array(6 * count);
  for (let quad = 0; quad < count; quad++) {
    indices.set([0, 1, 2, 2, 1, 3].map((corner) => 4 * quad + corner), 6 * quad);
  }
  return indices;
}

/** A texture that splats are blended into. */
class BlendTarget {
  /**
   * @param {WebGL2RenderingContext} gl
   * @param {number} format
   * @param {number} width
   * @param {number} height
   */
  constructor(gl, format, width, height) {
    this.gl = gl;
    this.format = format;
    this.width = width;
    this.height = height;
    this.texture = createTexture(gl, format, width, height);
    this.framebuffer = createFramebuffer(gl, [this.texture]);
  }

  /** Frees the texture. */
  dispose() {
    this.gl.deleteTexture(this.texture);
    this.gl.deleteFramebuffer(this.framebuffer);
  }
}

/** The splats of a placement in textures. */
class SplatTextures {
  /**
   * @param {WebGL2RenderingContext} gl
   * @param {SplatPlacement} placement
   */
  constructor(gl, placement) {
    this.gl = gl;
    this.placement = placement;
    const { document, bytes, motions, ranges, count } = placement;
    const largest = gl.getParameter(gl.MAX_TEXTURE_SIZE) ?? Infinity;
    this.packers = document.nodes.map((node, k) => new HarmonicsPacker(node, bytes, motions[k].harmonics));
    /** First texel of every node's coefficients. @type {number[]} */
    this.bases = [];
    let texels = 0;
    for (const [index, { values }] of this.packers.entries()) {
      this.bases.push(texels);
      texels += document.nodes[index].splats.count * harmonicsTexels(values);
    }
    this.harmonicsWidth = Math.min(2 * SPLATS_PER_ROW, largest);
    this.rows = Math.max(1, Math.ceil(count / SPLATS_PER_ROW));
    const harmonicsRows = Math.max(1, Math.ceil(texels / this.harmonicsWidth));
    this.tableRows = Math.max(1, Math.ceil(ranges.length / RANGES_PER_ROW));
    if (Math.max(this.rows, harmonicsRows, this.tableRows) > largest) {
      throw new Error(`The scene has ${count} splats, more than the textures of this graphics card hold.`);
    }
    const tableWidth = RANGES_PER_ROW * TABLE_TEXELS;
    this.centres = createTexture(gl, gl.RGBA32F, SPLATS_PER_ROW, this.rows);
    this.turns = createTexture(gl, gl.RGBA32F, SPLATS_PER_ROW, this.rows);
    this.sizes = createTexture(gl, gl.RGBA32F, SPLATS_PER_ROW, this.rows);
    this.harmonics = createTexture(gl, gl.RGBA16F, this.harmonicsWidth, harmonicsRows);
    this.table = createTexture(gl, gl.RGBA32F, tableWidth, this.tableRows);
    this.rangeInfo = createTexture(gl, gl.RGBA32UI, RANGES_PER_ROW, this.tableRows);
    this.places = createTexture(gl, gl.RGBA32UI, SPLATS_PER_ROW, this.rows);
    this.paints = createTexture(gl, gl.RGBA32UI, SPLATS_PER_ROW, this.rows);
    this.order = createTexture(gl, gl.R32UI, SPLATS_PER_ROW, this.rows);
    this.framebuffer = createFramebuffer(gl, [this.places, this.paints]);
    this.tableValues = new Float32Array(4 * tableWidth * this.tableRows);
    const chunk = Math.max(0, ...this.packers.map(({ values }) => harmonicsTexels(values)));
    this.chunkValues = new Float32Array(4 * chunk * HARMONICS_CHUNK);

    this.writeRows(this.centres, placement.centres, 0, count);
    this.writeRows(this.turns, placement.turns, 0, count);
    this.writeRows(this.sizes, placement.sizes, 0, count);
    for (const node of document.nodes.keys()) this.writeHarmonics(node);
    this.writeInfo();
  }

  /**
   * Uploads the rows that hold a range of splats.
   * @param {WebGLTexture} texture
   * @param {Float32Array} values Of all splats.
   * @param {number} first
   * @param {number} count
   */
  writeRows(texture, values, first, count) {
    if (count === 0) return;
    const { gl } = this;
    const start = Math.floor(first / SPLATS_PER_ROW);
    const height = Math.floor((first + count - 1) / SPLATS_PER_ROW) + 1 - start;
    const from = 4 * SPLATS_PER_ROW * start;
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, start, SPLATS_PER_ROW, height, gl.RGBA, gl.FLOAT, values, from);
  }

  /**
   * Uploads the coefficients of a node.
   * @param {number} node
   */
  writeHarmonics(node) {
    const { gl, packers, bases, chunkValues, harmonicsWidth, placement } = this;
    const { count } = placement.document.nodes[node].splats;
    const texels = harmonicsTexels(packers[node].values);
    gl.bindTexture(gl.TEXTURE_2D, this.harmonics);
    for (let start = 0; start < count; start += HARMONICS_CHUNK) {
      const size = Math.min(HARMONICS_CHUNK, count - start);
      packers[node].pack(start, size, chunkValues);
      writeTexels(gl, harmonicsWidth, bases[node] + start * texels, size * texels, chunkValues);
    }
  }

  /** Uploads where the coefficients of every range are. */
  writeInfo() {
    const { gl, bases, packers, placement, tableRows } = this;
    const values = new Uint32Array(4 * RANGES_PER_ROW * tableRows);
    for (const [index, { node, first }] of placement.ranges.entries()) {
      const skipped = (first - placement.firsts[node]) * harmonicsTexels(packers[node].values);
      const { degree } = placement.document.nodes[node].splats;
      values.set([first, bases[node] + skipped, degree, node], 4 * index);
    }
    gl.bindTexture(gl.TEXTURE_2D, this.rangeInfo);
    gl.texSubImage2D(
      gl.TEXTURE_2D, 0, 0, 0, RANGES_PER_ROW, tableRows, gl.RGBA_INTEGER, gl.UNSIGNED_INT, values,
    );
  }

  /**
   * Uploads the frames of the ranges as the camera sees them, and how their nodes look.
   * @param {number} selected
   */
  writeTable(selected) {
    const { gl, placement, tableValues, tableRows } = this;
    for (const [index, { node, shown, rows, centre }] of placement.ranges.entries()) {
      const at = 4 * TABLE_TEXELS * index;
      tableValues.set(rows, at);
      tableValues.set(centre, at + 12);
      const { color } = placement.document.nodes[node];
      for (let channel = 0; channel < 3; channel++) tableValues[at + 16 + channel] = color[channel] / 255;
      tableValues[at + 19] = shown ? (node === selected ? 2 : 1) : 0;
    }
    const width = RANGES_PER_ROW * TABLE_TEXELS;
    gl.bindTexture(gl.TEXTURE_2D, this.table);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, width, tableRows, gl.RGBA, gl.FLOAT, tableValues);
  }

  /**
   * Uploads the order in which splats are drawn.
   * @param {Uint32Array} order Padded to whole rows.
   * @param {number} drawn
   */
  writeOrder(order, drawn) {
    const { gl } = this;
    const height = Math.ceil(drawn / SPLATS_PER_ROW);
    if (height === 0) return;
    gl.bindTexture(gl.TEXTURE_2D, this.order);
    gl.texSubImage2D(
      gl.TEXTURE_2D, 0, 0, 0, SPLATS_PER_ROW, height, gl.RED_INTEGER, gl.UNSIGNED_INT, order,
    );
  }

  /**
   * Uploads what changed of a node.
   * @param {SplatChange} change
   */
  write({ node, centres, turns, sizes, harmonics }) {
    const { placement } = this;
    const first = placement.firsts[node];
    const { count } = placement.document.nodes[node].splats;
    if (centres) this.writeRows(this.centres, placement.centres, first, count);
    if (turns) this.writeRows(this.turns, placement.turns, first, count);
    if (sizes) this.writeRows(this.sizes, placement.sizes, first, count);
    if (harmonics) this.writeHarmonics(node);
  }

  /** Frees the textures. */
  dispose() {
    const { gl, centres, turns, sizes, harmonics, table, rangeInfo, places, paints, order } = this;
    for (const texture of [centres, turns, sizes, harmonics, table, rangeInfo, places, paints, order]) {
      gl.deleteTexture(texture);
    }
    gl.deleteFramebuffer(this.framebuffer);
  }
}

/** What the engine keeps in the graphics context apart from splats; made anew when the context was lost. */
class DrawingTools {
  /** @param {WebGL2RenderingContext} gl */
  constructor(gl) {
    this.gl = gl;
    if (!gl.getExtension('EXT_color_buffer_float') && !gl.isContextLost()) {
      throw new Error(
        'The graphics driver of this browser does not draw to floating-point images, which the viewer needs. '
        + 'Try another browser or update the driver.',
      );
    }
    const blendsFloats = gl.getExtension('EXT_float_blend') !== null;
    /** Format of images that are measured. */
    this.exactFormat = blendsFloats ? gl.RGBA32F : gl.RGBA16F;
    this.project = buildProgram(gl, COVER_VERTEX, PROJECT_FRAGMENT);
    this.blend = buildProgram(gl, SPLAT_VERTEX, SPLAT_FRAGMENT);
    this.compose = buildProgram(gl, COVER_VERTEX, COMPOSE_FRAGMENT);
    this.buffer = gl.createBuffer();
    this.cover = gl.createVertexArray();
    this.quads = gl.createVertexArray();
    gl.bindVertexArray(this.quads);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, this.buffer);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, quadIndices(SPLATS_PER_INSTANCE), gl.STATIC_DRAW);
    gl.bindVertexArray(null);
    gl.disable(gl.DEPTH_TEST);
    gl.disable(gl.DITHER);
    /** @type {BlendTarget | null} */
    this.target = null;
  }

  /**
   * A cleared image to blend into; the last one when it fits.
   * @param {number} format
   * @param {number} width
   * @param {number} height
   * @returns {BlendTarget}
   */
  targetOf(format, width, height) {
    const { gl, target } = this;
    const fits = target && target.format === format && target.width === width && target.height === height;
    const used = fits ? target : new BlendTarget(gl, format, width, height);
    if (!fits && target) target.dispose();
    this.target = used;
    gl.bindFramebuffer(gl.FRAMEBUFFER, used.framebuffer);
    gl.viewport(0, 0, width, height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    return used;
  }

  /** Frees everything. */
  dispose() {
    const { gl } = this;
    for (const { program } of [this.project, this.blend, this.compose]) gl.deleteProgram(program);
    gl.deleteBuffer(this.buffer);
    gl.deleteVertexArray(this.cover);
    gl.deleteVertexArray(this.quads);
    if (this.target) this.target.dispose();
    this.target = null;
  }
}

/**
 * A document that the engine can read.
 * @param {Document} document
 */
function checkDocument({ version }) {
  if (version !== DOCUMENT_VERSION) {
    throw new Error(`The scene has version ${version}; this page reads version ${DOCUMENT_VERSION}.`);
  }
}

/**
 * The colours of the splats of all nodes.
 * @param {Document} document
 * @returns {Look}
 */
function plainLook(document) {
  return { mode: 'color', tint: 0, visible: document.nodes.map(() => true), selected: -1 };
}

/**
 * A context to draw to a canvas.
 * @param {HTMLCanvasElement} canvas
 * @returns {WebGL2RenderingContext}
 */
function contextOf(canvas) {
  const gl = canvas.getContext('webgl2', {
    alpha: false,
    antialias: false,
    depth: false,
    powerPreference: 'high-performance',
  });
  if (gl) return gl;
  throw new Error(
    'This browser does not offer WebGL 2, which the viewer needs. '
    + 'Try another browser, or allow hardware acceleration in its settings.',
  );
}

/** Shows a document in a canvas. */
export class Engine {
  /**
   * @param {HTMLCanvasElement} canvas
   * @param {Document} document
   * @param {ArrayBuffer} bytes
   */
  constructor(canvas, document, bytes) {
    checkDocument(document);
    this.canvas = canvas;
    this.gl = contextOf(canvas);
    this.document = document;
    this.code = document.timeline.start;
    this.placement = new SplatPlacement(document, bytes, SPLATS_PER_ROW);
    this.placement.setTime(this.code);
    this.order = new DepthOrder(this.placement.count, SPLATS_PER_ROW);
    /** @type {Look} */
    this.look = plainLook(document);
    this.tools = new DrawingTools(this.gl);
    this.textures = new SplatTextures(this.gl, this.placement);
    /** Counts changes of placement. */
    this.version = 0;
    /** What the order was sorted for. */
    this.sortedFor = '';
    this.sortMs = 0;
    /** Nearest and farthest depth of the ramp. @type {[number, number] | null} */
    this.depths = null;
    /** The last drawing, for restored contexts. @type {{ shot: Camera, lowPass: number } | null} */
    this.last = null;
    this.listeners = new AbortController();
    const { signal } = this.listeners;
    canvas.addEventListener('webglcontextlost', (event) => event.preventDefault(), { signal });
    canvas.addEventListener('webglcontextrestored', () => this.restore(), { signal });
  }

  /** Makes everything anew in a context that was lost, and repeats the last drawing. */
  restore() {
    this.tools = new DrawingTools(this.gl);
    this.textures = new SplatTextures(this.gl, this.placement);
    this.sortedFor = '';
    if (this.last) this.draw(this.last.shot, this.last.lowPass);
  }

  /**
   * Shows another document at the same time code. The look is kept where the number of nodes is the same.
   * @param {Document} document
   * @param {ArrayBuffer} bytes
   */
  replace(document, bytes) {
    checkDocument(document);
    const placement = new SplatPlacement(document, bytes, SPLATS_PER_ROW);
    placement.setTime(this.code);
    const textures = new SplatTextures(this.gl, placement);
    this.textures.dispose();
    this.textures = textures;
    this.placement = placement;
    this.document = document;
    this.order = new DepthOrder(placement.count, SPLATS_PER_ROW);
    this.sortedFor = '';
    this.depths = null;
    if (this.look.visible.length !== document.nodes.length) {
      this.look = { ...this.look, visible: document.nodes.map(() => true), selected: -1 };
    }
  }

  /** Takes poses of the document that were changed. */
  refresh() {
    const { code } = this;
    this.code = Number.NaN;
    this.setTime(code);
  }

  /**
   * Goes to a time code.
   * @param {number} code
   */
  setTime(code) {
    if (code === this.code) return;
    this.code = code;
    const { changes, moved } = this.placement.setTime(code);
    for (const change of changes) this.textures.write(change);
    if (moved) this.version++;
  }

  /**
   * Erases splats of a node in place of those that were erased before.
   * @param {number} node
   * @param {Set<number>} splats Places among the splats of the node.
   */
  erase(node, splats) {
    this.placement.erase(node, splats);
    this.textures.write({ node, centres: true, turns: false, sizes: false, harmonics: false });
    this.version++;
  }

  /**
   * Opacities of the splats of a node as the document has them, at each of their samples.
   * @param {number} node
   * @returns {{ code: number, values: Float32Array }[]}
   */
  opacities(node) {
    const { bytes } = this.placement;
    const { opacities, splats } = this.document.nodes[node];
    const { start } = this.document.timeline;
    if (!opacities) return [{ code: start, values: decodeArray(bytes, splats.opacities) }];
    const all = decodeArray(bytes, opacities.values);
    return opacities.codes.map((code, k) => {
      return { code, values: all.slice(k * splats.count, (k + 1) * splats.count) };
    });
  }

  /**
   * Splats of a node whose centres are seen near a pixel, whatever is in front of them.
   * @param {Camera} shot
   * @param {number} node
   * @param {number[]} pixel
   * @param {number} radius Pixels.
   * @returns {number[]} Places among the splats of the node.
   */
  splatsNear(shot, node, pixel, radius) {
    const { ranges, centres, firsts } = this.placement;
    this.aim(shot, this.look);
    const found = [];
    for (const { first, count, rows } of ranges.filter((range) => range.node === node)) {
      for (let splat = first; splat < first + count; splat++) {
        const [x, y, z] = [0, 4, 8].map(
          (row) =>
            rows[row] * centres[4 * splat] + rows[row + 1] * centres[4 * splat + 1]
            + rows[row + 2] * centres[4 * splat + 2] + rows[row + 3],
        );
        if (z < this.near()) continue;
        const right = (shot.focal[0] * x) / z + shot.principal[0] - pixel[0];
        const down = (shot.focal[1] * y) / z + shot.principal[1] - pixel[1];
        if (Math.hypot(right, down) <= radius) found.push(splat - firsts[node]);
      }
    }
    return found;
  }

  /**
   * Sets how the splats are coloured and which are shown.
   * @param {Look} look
   */
  setLook(look) {
    this.look = { ...look, visible: [...look.visible] };
  }

  /**
   * Draws to the canvas, whose size becomes that of the shot.
   * @param {Camera} shot
   * @param {number} lowPass Dilation, px^2.
   */
  draw(shot, lowPass) {
    const { canvas, gl } = this;
    const [width, height] = shot.size;
    this.last = { shot, lowPass };
    if (gl.isContextLost() || width < 1 || height < 1) return;
    if (canvas.width !== width) canvas.width = width;
    if (canvas.height !== height) canvas.height = height;
    const image = this.render(shot, lowPass, this.look, gl.RGBA16F);
    this.compose(image, this.look, null, false);
  }

  /**
   * Draws beside the canvas and returns RGBA, first row on top.
   * @param {Camera} shot
   * @param {number} lowPass Dilation, px^2.
   * @param {boolean} [plain] True: all nodes in the colours of their splats, over the document's background.
   * @returns {Uint8ClampedArray<ArrayBuffer>}
   */
  pixels(shot, lowPass, plain = false) {
    const { gl, tools, document } = this;
    const [width, height] = shot.size;
    const look = plain ? plainLook(document) : this.look;
    const values = new Uint8ClampedArray(4 * width * height);
    const image = this.render(shot, lowPass, look, tools.exactFormat);
    const shown = new BlendTarget(gl, gl.RGBA8, width, height);
    this.compose(image, look, shown, true);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, values);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    shown.dispose();
    return values;
  }

  /**
   * Projects and blends.
   * @param {Camera} shot
   * @param {number} lowPass
   * @param {Look} look
   * @param {number} format
   * @returns {BlendTarget}
   */
  render(shot, lowPass, look, format) {
    const { gl, tools, textures, order } = this;
    const [width, height] = shot.size;
    const depths = look.mode === 'depth' ? this.depthRange(shot) : [1, 2];
    this.aim(shot, look);
    this.sort(shot);
    this.project(shot, lowPass, look, depths);

    const image = tools.targetOf(format, width, height);
    if (order.drawn === 0) return image;
    gl.useProgram(tools.blend.program);
    const { places, paints, order: ranks } = textures;
    bindTextures(gl, tools.blend, { places, paints, order: ranks });
    gl.uniform2f(tools.blend.uniforms.size, width, height);
    gl.uniform1i(tools.blend.uniforms.drawn, order.drawn);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.bindVertexArray(tools.quads);
    const instances = Math.ceil(order.drawn / SPLATS_PER_INSTANCE);
    const quads = Math.min(order.drawn, SPLATS_PER_INSTANCE);
    gl.drawElementsInstanced(gl.TRIANGLES, 6 * quads, gl.UNSIGNED_SHORT, 0, instances);
    gl.disable(gl.BLEND);
    return image;
  }

  /**
   * Puts the ranges before a camera.
   * @param {Camera} shot
   * @param {Look} look
   */
  aim({ pose }, look) {
    const cameraFromWorld = inverse([pose[0], pose[1], pose[2], ...normalizeQuaternion(turnOf(pose))]);
    for (const range of this.placement.ranges) {
      range.setCamera(cameraFromWorld);
      range.shown = this.placement.visible[range.node] && look.visible[range.node] !== false;
    }
  }

  /**
   * Sorts the splats and uploads their order, unless that is done.
   * @param {Camera} shot
   */
  sort({ pose }) {
    const { order, placement, textures } = this;
    const shown = placement.ranges.map((range) => (range.shown ? '1' : '0')).join('');
    const key = `${this.version} ${shown} ${Array.from(pose).join(' ')}`;
    if (key === this.sortedFor) return;
    const start = performance.now();
    order.update(placement.ranges, placement.centres, this.near(), this.document.sort === 'distance');
    this.sortMs = performance.now() - start;
    this.sortedFor = key;
    textures.writeOrder(order.order, order.drawn);
  }

  /**
   * Projects and colours every splat once.
   * @param {Camera} shot
   * @param {number} lowPass
   * @param {Look} look
   * @param {number[]} depths
   */
  project({ size, focal, principal }, lowPass, look, depths) {
    const { gl, tools, textures, placement } = this;
    const { centres, turns, sizes, harmonics, table, rangeInfo } = textures;
    textures.writeTable(look.selected);
    gl.bindFramebuffer(gl.FRAMEBUFFER, textures.framebuffer);
    gl.viewport(0, 0, SPLATS_PER_ROW, textures.rows);
    gl.useProgram(tools.project.program);
    bindTextures(gl, tools.project, { centres, turns, sizes, harmonics, table, rangeInfo });
    const { uniforms } = tools.project;
    gl.uniform1i(uniforms.splatCount, placement.count);
    gl.uniform1i(uniforms.harmonicsWidth, textures.harmonicsWidth);
    gl.uniform2f(uniforms.size, size[0], size[1]);
    gl.uniform2f(uniforms.focal, focal[0], focal[1]);
    gl.uniform2f(uniforms.principal, principal[0], principal[1]);
    gl.uniform1f(uniforms.lowPass, lowPass);
    gl.uniform1f(uniforms.near, this.near());
    gl.uniform1i(uniforms.isAntialiased, this.document.antialiased ? 1 : 0);
    gl.uniform1i(uniforms.mode, MODES[look.mode]);
    gl.uniform1f(uniforms.tint, look.tint);
    gl.uniform2f(uniforms.depthRange, depths[0], depths[1]);
    gl.bindVertexArray(tools.cover);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  /**
   * Puts blended splats over the background.
   * @param {BlendTarget} image
   * @param {Look} look
   * @param {BlendTarget | null} to Null for the canvas.
   * @param {boolean} isTopFirst True to write the top row first.
   */
  compose(image, look, to, isTopFirst) {
    const { gl, tools } = this;
    const [red, green, blue] = look.background ?? this.document.background;
    gl.bindFramebuffer(gl.FRAMEBUFFER, to && to.framebuffer);
    gl.viewport(0, 0, image.width, image.height);
    gl.useProgram(tools.compose.program);
    bindTextures(gl, tools.compose, { image: image.texture });
    const { uniforms } = tools.compose;
    gl.uniform3f(uniforms.background, red, green, blue);
    gl.uniform1i(uniforms.isDepth, look.mode === 'depth' ? 1 : 0);
    gl.uniform1i(uniforms.isTopFirst, isTopFirst ? 1 : 0);
    gl.bindVertexArray(tools.cover);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  /**
   * Near plane, world units.
   * @returns {number}
   */
  near() {
    return this.document.near ?? DEFAULT_NEAR;
  }

  /**
   * Depths between which 98 % of the splats lie that the recorded cameras see; without those, `shot` counts.
   * @param {Camera} shot
   * @returns {[number, number]}
   */
  depthRange(shot) {
    if (this.depths) return this.depths;
    const { placement, look } = this;
    const recorded = this.document.cameras.flatMap((camera) => camera.samples);
    const step = Math.max(1, Math.ceil(recorded.length / 8));
    const shots = recorded.length > 0 ? recorded.filter((_, index) => index % step === 0) : [shot];
    const stride = Math.max(1, Math.ceil(placement.count / 4000));
    /** @type {number[]} */
    const found = [];
    const collect = (/** @type {Camera} */ seen) => {
      this.aim(seen, look);
      for (const range of placement.ranges) {
        collectDepths(range, placement.centres, seen, stride, this.near(), found);
      }
    };
    shots.forEach(collect);
    found.sort((a, b) => a - b);
    const near = found[Math.floor(0.01 * found.length)] ?? this.near();
    const far = found[Math.floor(0.99 * found.length)] ?? 10 * near;
    this.depths = [near, Math.max(far, 1.01 * near)];
    return this.depths;
  }

  /**
   * What a pixel shows: all splats there, blended front to back in double precision.
   * @param {Camera} shot
   * @param {number} lowPass Dilation, px^2.
   * @param {number} x Pixels from the left edge; the centre of the first pixel is at 0.5.
   * @param {number} y Pixels from the top edge.
   * @returns {Picked}
   */
  pick(shot, lowPass, x, y) {
    const { placement, document } = this;
    this.aim(shot, this.look);
    const byDistance = document.sort === 'distance';
    const seeker = new PixelSeeker(shot, lowPass, [x, y], document.antialiased, byDistance);
    for (const range of placement.ranges) {
      if (range.shown) seeker.seek(range, placement, this.near());
    }
    const { weights, total, depth } = seeker.blend(document.nodes.length);
    if (total < 0.5) return { node: -1, point: null, depth: null };
    const { focal, principal, pose } = shot;
    const ray = [(x - principal[0]) / focal[0], (y - principal[1]) / focal[1], 1];
    const point = transformPoint(pose, ray.map((value) => value * depth));
    return { node: weights.indexOf(Math.max(...weights)), point, depth };
  }

  /**
   * `world_from_local` of a node.
   * @param {number} node
   * @param {number} code
   * @returns {number[]}
   */
  pose(node, code) {
    return poseAt(this.document.nodes[node].track, code);
  }

  /**
   * `world_from_part` of a part of a node.
   * @param {number} node
   * @param {number} part
   * @param {number} code
   * @returns {number[]}
   */
  partPose(node, part, code) {
    return partPoseAt(this.document.nodes[node], part, code);
  }

  /**
   * True when a node can be seen at a time code.
   * @param {number} node
   * @param {number} code
   * @returns {boolean}
   */
  isVisible(node, code) {
    return isVisibleAt(this.document.nodes[node].visibility, code);
  }

  /**
   * Number of splats, how many of them the last drawing had, and how long sorting took.
   * @returns {{ splats: number, drawn: number, sortMs: number }}
   */
  statistics() {
    return { splats: this.placement.count, drawn: this.order.drawn, sortMs: this.sortMs };
  }

  /** Frees everything; the canvas can be used again. */
  dispose() {
    this.listeners.abort();
    this.textures.dispose();
    this.tools.dispose();
  }
}

/**
 * Appends depths of splats of a range that a camera sees.
 * @param {SplatRange} range
 * @param {Float32Array} centres
 * @param {Camera} shot
 * @param {number} stride Every so many splats.
 * @param {number} near
 * @param {number[]} found
 */
function collectDepths({ first, count, rows }, centres, { size, focal, principal }, stride, near, found) {
  for (let splat = first; splat < first + count; splat += stride) {
    const [x, y, z] = localToCamera(rows, centres, 4 * splat);
    const column = (focal[0] * x) / z + principal[0];
    const row = (focal[1] * y) / z + principal[1];
    const isInside = column >= 0 && column <= size[0] && row >= 0 && row <= size[1];
    if (z >= near && isInside && centres[4 * splat + 3] >= 0.1) found.push(z);
  }
}

/**
 * A splat's centre in the camera frame.
 * @param {Float64Array} m Three rows of four.
 * @param {Float32Array} centres
 * @param {number} at
 * @returns {[number, number, number]}
 */
function localToCamera(m, centres, at) {
  const x = centres[at];
  const y = centres[at + 1];
  const z = centres[at + 2];
  return [
    m[0] * x + m[1] * y + m[2] * z + m[3],
    m[4] * x + m[5] * y + m[6] * z + m[7],
    m[8] * x + m[9] * y + m[10] * z + m[11],
  ];
}

/** Finds the splats that a pixel shows. */
class PixelSeeker {
  /**
   * @param {Camera} shot
   * @param {number} lowPass
   * @param {number[]} pixel
   * @param {boolean} isAntialiased
   * @param {boolean} byDistance
   */
  constructor({ size, focal, principal }, lowPass, pixel, isAntialiased, byDistance) {
    this.focal = focal;
    this.principal = principal;
    this.lowPass = lowPass;
    this.pixel = pixel;
    this.isAntialiased = isAntialiased;
    this.byDistance = byDistance;
    this.low = [0, 1].map((axis) => -(principal[axis] + 0.15 * size[axis]) / focal[axis]);
    this.high = [0, 1].map((axis) => (1.15 * size[axis] - principal[axis]) / focal[axis]);
    /** @type {{ key: number, splat: number, node: number, alpha: number, depth: number }[]} */
    this.found = [];
  }

  /**
   * Adds the splats of a range whose weight reaches 1/255 at the pixel.
   * @param {SplatRange} range
   * @param {SplatPlacement} placement
   * @param {number} near
   */
  seek(range, { centres, turns, sizes }, near) {
    const { focal, principal, pixel, lowPass } = this;
    for (let splat = range.first; splat < range.first + range.count; splat++) {
      const at = 4 * splat;
      const opacity = centres[at + 3];
      if (!(opacity >= MIN_ALPHA)) continue;
      const [x, y, z] = localToCamera(range.rows, centres, at);
      if (!(z >= near)) continue;
      const dx = (focal[0] * x) / z + principal[0] - pixel[0];
      const dy = (focal[1] * y) / z + principal[1] - pixel[1];
      // No variance is larger than this: quick rejection of nearly all splats.
      const rx = Math.min(this.high[0], Math.max(this.low[0], x / z));
      const ry = Math.min(this.high[1], Math.max(this.low[1], y / z));
      const largest = Math.max(sizes[at], sizes[at + 1], sizes[at + 2]) ** 2 / z ** 2;
      const reach = 2 * Math.log(opacity / MIN_ALPHA);
      if (dx * dx > reach * (largest * focal[0] ** 2 * (1 + rx * rx) + lowPass)) continue;
      if (dy * dy > reach * (largest * focal[1] ** 2 * (1 + ry * ry) + lowPass)) continue;
      const alpha = this.weigh(range.rows, turns, sizes, at, [rx, ry], z, opacity, dx, dy);
      if (!(alpha >= MIN_ALPHA)) continue;
      const key = Math.fround(this.byDistance ? Math.hypot(x, y, z) : z);
      this.found.push({ key, splat, node: range.node, alpha, depth: z });
    }
  }

  /**
   * Weight of a splat at the pixel.
   * @param {Float64Array} rows
   * @param {Float32Array} turns
   * @param {Float32Array} sizes
   * @param {number} at
   * @param {number[]} ratio Clamped x / z and y / z.
   * @param {number} z
   * @param {number} opacity
   * @param {number} dx Centre less pixel.
   * @param {number} dy
   * @returns {number}
   */
  weigh(rows, turns, sizes, at, ratio, z, opacity, dx, dy) {
    const turn = normalizeQuaternion([turns[at], turns[at + 1], turns[at + 2], turns[at + 3]]);
    const axes = toRotation(turn);
    let c00 = this.lowPass;
    let c01 = 0;
    let c11 = this.lowPass;
    const columns = [];
    for (let c = 0; c < 3; c++) {
      const s = sizes[at + c];
      const spread = [0, 4, 8].map(
        (row) => s * (rows[row] * axes[c] + rows[row + 1] * axes[3 + c] + rows[row + 2] * axes[6 + c]),
      );
      const a = (this.focal[0] / z) * (spread[0] - ratio[0] * spread[2]);
      const b = (this.focal[1] / z) * (spread[1] - ratio[1] * spread[2]);
      columns.push([a, b]);
      c00 += a * a;
      c01 += a * b;
      c11 += b * b;
    }
    let sharp = 0;
    for (const [j, k] of [[0, 1], [1, 2], [2, 0]]) {
      sharp += (columns[j][0] * columns[k][1] - columns[k][0] * columns[j][1]) ** 2;
    }
    const trace = c00 + c11 - 2 * this.lowPass;
    const determinant = sharp + this.lowPass * trace + this.lowPass ** 2;
    const factor = this.isAntialiased ? Math.max(Math.sqrt(sharp / determinant), 0.005) : 1;
    const l00 = Math.sqrt(c11 / determinant);
    const u0 = l00 * (dx - (c01 / c11) * dy);
    const u1 = dy / Math.sqrt(c11);
    return Math.min(MAX_ALPHA, opacity * factor * Math.exp(-0.5 * (u0 * u0 + u1 * u1)));
  }

  /**
   * Blends what was found: weights by node, their sum, and the depth at which half of it is reached.
   * @param {number} nodes Number of nodes.
   * @returns {{ weights: number[], total: number, depth: number }}
   */
  blend(nodes) {
    const { found } = this;
    found.sort((a, b) => a.key - b.key || a.splat - b.splat);
    const weights = new Array(nodes).fill(0);
    /** @type {{ depth: number, total: number }[]} */
    const reached = [];
    let transmittance = 1;
    for (const { node, alpha, depth } of found) {
      const next = transmittance * (1 - alpha);
      if (next < MIN_TRANSMITTANCE) break;
      weights[node] += transmittance - next;
      transmittance = next;
      reached.push({ depth, total: 1 - transmittance });
    }
    const total = 1 - transmittance;
    const median = reached.find((entry) => entry.total >= 0.5 * total);
    return { weights, total, depth: median ? median.depth : 0 };
  }
}
