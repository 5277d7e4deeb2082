// Shaders: splats are projected once each, drawn as quads back to front, and put over the background.

/** Splats per row of the textures. */
export const SPLATS_PER_ROW = 2048;

/** Texels per range in the table of ranges: three rows of `camera_from_local`, camera centre, colour. */
export const TABLE_TEXELS = 8;

/** Splats that one instance of the drawing holds; instances of single quads are slow. */
export const SPLATS_PER_INSTANCE = 1024;

/** Ranges per row of the table of ranges. */
export const RANGES_PER_ROW = 128;

const HEADER = `#version 300 es
precision highp float;
precision highp int;
precision highp sampler2D;
precision highp usampler2D;
const float MIN_ALPHA = 1.0 / 255.0;
`;

/** A triangle over the whole target. */
export const COVER_VERTEX = `${HEADER}
void main() {
  vec2 corner = vec2(float((gl_VertexID & 1) << 2), float((gl_VertexID & 2) << 1));
  gl_Position = vec4(corner - 1.0, 0.0, 1.0);
}
`;

/** One fragment per splat: projection and colour. An opacity of 0 marks what is not drawn. */
export const PROJECT_FRAGMENT = `${HEADER}
uniform sampler2D centres;
uniform sampler2D turns;
uniform sampler2D sizes;
uniform sampler2D harmonics;
uniform sampler2D table;
uniform usampler2D rangeInfo;
uniform int splatCount;
uniform int harmonicsWidth;
uniform vec2 size;
uniform vec2 focal;
uniform vec2 principal;
uniform float lowPass;
uniform float near;
uniform bool isAntialiased;
uniform int mode;
uniform float tint;
uniform vec2 depthRange;

// Centre in pixels, L00, L01.
layout(location = 0) out uvec4 place;
// L11, opacity, colour in half precision.
layout(location = 1) out uvec4 paint;

const float MAX_COVARIANCE = 1e18;
const float JACOBIAN_MARGIN = 0.3;
const float MIN_ANTIALIASING = 0.005;
const float MIN_SCALE = 2.0611536e-9;
const float MAX_SCALE = 22026.4657948;

mat3 rotationOf(vec4 q) {
  float w = q.x, x = q.y, y = q.z, z = q.w;
  return mat3(
    1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
    2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
    2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
}

vec4 coefficient(int texel) {
  return texelFetch(harmonics, ivec2(texel % harmonicsWidth, texel / harmonicsWidth), 0);
}

// 0.5 + the sum of the harmonics, at a unit direction.
vec3 radiance(vec3 d, int degree, int texel) {
  float x = d.x, y = d.y, z = d.z;
  float xx = x * x, yy = y * y, zz = z * z;
  vec4 b[4];
  b[0] = vec4(0.28209479177387814, -0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x);
  b[1] = vec4(1.0925484305920792 * x * y, -1.0925484305920792 * y * z,
    0.31539156525252005 * (2.0 * zz - xx - yy), -1.0925484305920792 * x * z);
  b[2] = vec4(0.5462742152960396 * (xx - yy), -0.5900435899266435 * y * (3.0 * xx - yy),
    2.890611442640554 * x * y * z, -0.4570457994644658 * y * (4.0 * zz - xx - yy));
  b[3] = vec4(0.3731763325901154 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
    -0.4570457994644658 * x * (4.0 * zz - xx - yy), 1.445305721320277 * z * (xx - yy),
    -0.5900435899266435 * x * (xx - 3.0 * yy));
  int count = (degree + 1) * (degree + 1);
  vec3 sum = vec3(0.5);
  for (int group = 0; group < 4; group++) {
    if (4 * group >= count) break;
    vec4 first = coefficient(texel + 3 * group);
    sum += b[group].x * first.rgb;
    if (4 * group + 1 >= count) break;
    vec4 second = coefficient(texel + 3 * group + 1);
    vec4 third = coefficient(texel + 3 * group + 2);
    sum += b[group].y * vec3(first.a, second.rg) + b[group].z * vec3(second.ba, third.r)
      + b[group].w * third.gba;
  }
  return sum;
}

void main() {
  place = uvec4(0u);
  paint = uvec4(0u);
  ivec2 at = ivec2(gl_FragCoord.xy);
  int splat = at.y * ${SPLATS_PER_ROW} + at.x;
  if (splat >= splatCount) return;
  vec4 centre = texelFetch(centres, at, 0);
  vec4 turn = texelFetch(turns, at, 0);
  vec4 scale = texelFetch(sizes, at, 0);
  int range = int(scale.w);
  ivec2 entry = ivec2((range % ${RANGES_PER_ROW}) * ${TABLE_TEXELS}, range / ${RANGES_PER_ROW});
  vec4 row0 = texelFetch(table, entry, 0);
  vec4 row1 = texelFetch(table, entry + ivec2(1, 0), 0);
  vec4 row2 = texelFetch(table, entry + ivec2(2, 0), 0);
  vec4 camera = texelFetch(table, entry + ivec2(3, 0), 0);
  vec4 owner = texelFetch(table, entry + ivec2(4, 0), 0);

  vec4 local = vec4(centre.xyz, 1.0);
  vec3 point = vec3(dot(row0, local), dot(row1, local), dot(row2, local));
  float norm = length(turn);
  if (owner.w < 0.5 || !(point.z >= near) || !(centre.w >= MIN_ALPHA) || !(norm >= 1e-6)) return;

  // T = J R_v B, with the ratios inside the Jacobian clamped.
  mat3 cameraFromLocal = transpose(mat3(row0.xyz, row1.xyz, row2.xyz));
  vec3 s = clamp(scale.xyz, MIN_SCALE, MAX_SCALE);
  mat3 spread = cameraFromLocal * rotationOf(turn / norm) * mat3(s.x, 0, 0, 0, s.y, 0, 0, 0, s.z);
  float r = 1.0 / point.z;
  vec2 ratio = point.xy * r;
  vec2 margin = JACOBIAN_MARGIN * 0.5 * size / focal;
  ratio = clamp(ratio, -(principal / focal + margin), (size - principal) / focal + margin);
  vec3 depths = vec3(spread[0].z, spread[1].z, spread[2].z);
  vec3 t0 = focal.x * r * (vec3(spread[0].x, spread[1].x, spread[2].x) - ratio.x * depths);
  vec3 t1 = focal.y * r * (vec3(spread[0].y, spread[1].y, spread[2].y) - ratio.y * depths);
  float largest = max(dot(t0, t0), dot(t1, t1));
  if (largest > MAX_COVARIANCE) {
    float factor = sqrt(MAX_COVARIANCE / largest);
    t0 *= factor;
    t1 *= factor;
  }
  vec3 sharp = vec3(dot(t0, t0), dot(t0, t1), dot(t1, t1));
  vec3 normal = cross(t0, t1);
  float sharpDeterminant = dot(normal, normal);
  float c00 = sharp.x + lowPass;
  float c11 = sharp.z + lowPass;
  float determinant = sharpDeterminant + lowPass * (sharp.x + sharp.z) + lowPass * lowPass;
  if (!(determinant < 3e38)) return;

  float opacity = centre.w;
  if (isAntialiased) {
    opacity *= sqrt(max(sharpDeterminant / determinant, MIN_ANTIALIASING * MIN_ANTIALIASING));
  }
  if (!(opacity >= MIN_ALPHA)) return;
  vec2 mean = focal * point.xy * r + principal;
  vec2 extents = sqrt(2.0 * log(opacity / MIN_ALPHA) * vec2(c00, c11));
  vec2 low = mean - extents;
  vec2 high = mean + extents;
  if (!(all(greaterThanEqual(high, vec2(0))) && all(lessThanEqual(low, size)))) return;

  vec3 color;
  if (mode == 2) {
    float t = log(point.z / depthRange.x) / log(depthRange.y / depthRange.x);
    color = vec3(clamp(t, 0.0, 1.0), 0.0, 0.0);
  } else {
    color = owner.rgb;
    if (mode == 0 && tint < 1.0) {
      uvec4 info = texelFetch(rangeInfo, ivec2(range % ${RANGES_PER_ROW}, range / ${RANGES_PER_ROW}), 0);
      int degree = int(info.z);
      int values = 3 * (degree + 1) * (degree + 1);
      int texel = int(info.y) + (splat - int(info.x)) * ((values + 3) / 4);
      vec3 offset = centre.xyz - camera.xyz;
      vec3 direction = offset / max(length(offset), 1e-8);
      color = mix(max(radiance(direction, degree, texel), 0.0), owner.rgb, tint);
    }
    if (!(color.r + color.g + color.b < 1e30)) return;
    color = min(color, 6e4);
    if (owner.w > 1.5) color = mix(color, owner.rgb, 0.18) + 0.06;
  }
  float l00 = sqrt(c11 / determinant);
  place = floatBitsToUint(vec4(mean, l00, -l00 * sharp.y / c11));
  paint = uvec4(floatBitsToUint(inversesqrt(c11)), floatBitsToUint(opacity),
    packHalf2x16(color.rg), packHalf2x16(vec2(color.b, 0.0)));
}
`;

/** A quad per splat: the parallelogram around the ellipse in which its weight reaches 1/255. */
export const SPLAT_VERTEX = `${HEADER}
uniform usampler2D places;
uniform usampler2D paints;
uniform usampler2D order;
uniform int drawn;
uniform vec2 size;
flat out vec2 mean;
flat out vec4 factor;
flat out vec3 color;

void main() {
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
  int rank = gl_InstanceID * ${SPLATS_PER_INSTANCE} + (gl_VertexID >> 2);
  if (rank >= drawn) return;
  int splat = int(texelFetch(order, ivec2(rank % ${SPLATS_PER_ROW}, rank / ${SPLATS_PER_ROW}), 0).x);
  ivec2 at = ivec2(splat % ${SPLATS_PER_ROW}, splat / ${SPLATS_PER_ROW});
  uvec4 paint = texelFetch(paints, at, 0);
  float opacity = uintBitsToFloat(paint.y);
  if (opacity < MIN_ALPHA) return;
  vec4 place = uintBitsToFloat(texelFetch(places, at, 0));
  mean = place.xy;
  factor = vec4(place.zw, uintBitsToFloat(paint.x), opacity);
  color = vec3(unpackHalf2x16(paint.z), unpackHalf2x16(paint.w).x);
  // A little wider, so that rounding of the corners loses no pixel.
  float reach = 1.001 * sqrt(2.0 * log(opacity / MIN_ALPHA)) + 0.001;
  vec2 u = reach * vec2(float(((gl_VertexID & 1) << 1) - 1), float((gl_VertexID & 2) - 1));
  vec2 d = vec2((u.x - factor.y * u.y / factor.z) / factor.x, u.y / factor.z);
  vec2 clip = 2.0 * (mean - d) / size - 1.0;
  gl_Position = vec4(clip.x, -clip.y, 0.0, 1.0);
}
`;

/** Premultiplied colour of a splat at a pixel. */
export const SPLAT_FRAGMENT = `${HEADER}
uniform vec2 size;
flat in vec2 mean;
flat in vec4 factor;
flat in vec3 color;
out vec4 blended;

void main() {
  vec2 d = mean - vec2(gl_FragCoord.x, size.y - gl_FragCoord.y);
  vec2 u = vec2(factor.x * d.x + factor.y * d.y, factor.z * d.y);
  float alpha = min(0.99, factor.w * exp(-0.5 * dot(u, u)));
  if (alpha < MIN_ALPHA) discard;
  blended = vec4(color * alpha, alpha);
}
`;

/** Puts the blended splats over the background. */
export const COMPOSE_FRAGMENT = `${HEADER}
uniform sampler2D image;
uniform vec3 background;
uniform bool isDepth;
uniform bool isTopFirst;
out vec4 shown;

// Polynomial fit of the viridis ramp, dark at 0 and bright at 1. Source: Matt Zucker, CC0.
vec3 ramp(float t) {
  const vec3 c0 = vec3(0.2777273272, 0.0054073445, 0.3340998053);
  const vec3 c1 = vec3(0.1050930431, 1.4046135299, 1.3845901627);
  const vec3 c2 = vec3(-0.3308618287, 0.2148475595, 0.0950951630);
  const vec3 c3 = vec3(-4.6342304990, -5.7991009734, -19.3324409563);
  const vec3 c4 = vec3(6.2282699363, 14.1799333668, 56.6905526007);
  const vec3 c5 = vec3(4.7763849977, -13.7451453777, -65.3530326334);
  const vec3 c6 = vec3(-5.4354558559, 4.6458526122, 26.3124352496);
  return c0 + t * (c1 + t * (c2 + t * (c3 + t * (c4 + t * (c5 + t * c6)))));
}

void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  if (isTopFirst) at.y = textureSize(image, 0).y - 1 - at.y;
  vec4 blended = texelFetch(image, at, 0);
  if (isDepth && blended.a > 0.0) {
    blended.rgb = blended.a * ramp(1.0 - clamp(blended.r / blended.a, 0.0, 1.0));
  }
  shown = vec4(blended.rgb + (1.0 - blended.a) * background, 1.0);
}
`;

/**
 * A program with the locations of its uniforms.
 * @typedef {object} ShaderProgram
 * @property {WebGLProgram} program
 * @property {Record<string, WebGLUniformLocation | null>} uniforms
 */

/**
 * Compiles and links a program.
 * @param {WebGL2RenderingContext} gl
 * @param {string} vertex
 * @param {string} fragment
 * @returns {ShaderProgram}
 */
export function buildProgram(gl, vertex, fragment) {
  const program = gl.createProgram();
  for (const [kind, source] of /** @type {[number, string][]} */ ([
    [gl.VERTEX_SHADER, vertex],
    [gl.FRAGMENT_SHADER, fragment],
  ])) {
    const shader = gl.createShader(kind);
    if (!shader) throw new Error('The graphics context was lost. Load the page again.');
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
    gl.deleteShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS) && !gl.isContextLost()) {
      throw new Error(`The graphics driver does not take a shader: ${gl.getShaderInfoLog(shader)}`);
    }
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) {
    throw new Error(`The graphics driver does not take a program: ${gl.getProgramInfoLog(program)}`);
  }
  /** @type {Record<string, WebGLUniformLocation | null>} */
  const uniforms = {};
  const count = gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS) ?? 0;
  for (let index = 0; index < count; index++) {
    const name = gl.getActiveUniform(program, index)?.name;
    if (name) uniforms[name] = gl.getUniformLocation(program, name);
  }
  return { program, uniforms };
}
