// The document that the page shows: JSON beside a block of bytes. The fields are documented in
// crates/cif-web/src/document.rs, which writes them.

/**
 * Translation x, y, z and unit quaternion w, x, y, z.
 * @typedef {ArrayLike<number>} Pose
 */

/**
 * Numbers in the block of bytes, little-endian: `value = stored * scale`.
 * @typedef {object} Stored
 * @property {number} at First byte, a multiple of four.
 * @property {number} length Number of values.
 * @property {'f32' | 'bf16' | 'i16' | 'i8'} kind How they are stored.
 * @property {number} scale Factor.
 */

/**
 * Poses over time: linear in translation, spherical in rotation between samples, held outside them.
 * @typedef {object} Track
 * @property {number[]} codes Ascending time codes, at least one.
 * @property {number[][]} poses A pose at each of them.
 */

/**
 * @typedef {object} Joint
 * @property {string} kind `revolute` or `prismatic`.
 * @property {string} base Name of the part that it moves on.
 * @property {number[]} axis Unit direction, frame of the part.
 * @property {number[]} anchor A point of the axis, frame of the part.
 * @property {number[] | null} range Smallest and largest value, radians or world units.
 */

/**
 * @typedef {object} Part
 * @property {string} name Unique in the node.
 * @property {number} first First splat of the node.
 * @property {number} count Number of splats.
 * @property {Track} track `node_from_part`.
 * @property {Joint | null} joint Null where the part is free.
 */

/**
 * @typedef {object} Visibility
 * @property {number} code Time code.
 * @property {boolean} visible True when the node can be seen from here on.
 */

/**
 * @typedef {object} Splats
 * @property {number} count Number of splats.
 * @property {Stored} centres `[count, 3]`.
 * @property {Stored} orientations Unit quaternions w, x, y, z, `[count, 4]`.
 * @property {Stored} scales Standard deviations, `[count, 3]`.
 * @property {Stored} opacities In [0, 1], `[count]`.
 * @property {number} degree Degree of the spherical harmonics, 0 to 3.
 * @property {Stored} base Coefficients of degree 0, `[count, 3]`.
 * @property {Stored | null} higher Coefficients of higher degrees, `[count, (degree + 1)^2 - 1, 3]`.
 */

/**
 * @typedef {object} Deformation
 * @property {number[]} codes Ascending time codes.
 * @property {Stored} offsets Centres less those of the splats, `[codes, count, 3]`.
 * @property {Stored} orientations Unit quaternions, `[codes, count, 4]`.
 * @property {Stored | null} scales Standard deviations, `[codes, count, 3]`.
 */

/**
 * Values over time: linear between samples, held outside them.
 * @typedef {object} Samples
 * @property {number[]} codes Ascending time codes.
 * @property {Stored} values Values of one sample after the other.
 */

/**
 * @typedef {object} Node
 * @property {'instance' | 'background' | 'points'} kind Kind of node.
 * @property {number | null} id Mask value.
 * @property {string} name Unique name.
 * @property {string} path Path of its prim.
 * @property {string} label Human name.
 * @property {string} category Class.
 * @property {number[]} color Colour in pictures of instances, 0 to 255.
 * @property {string} motion `static`, `rigid`, `parts` or `dense`.
 * @property {string | null} rotation Evidence for its rotation.
 * @property {number} mean_occupancy Opacity-weighted mean of the occupancies.
 * @property {number[][]} extent Smallest and largest corner, local frame.
 * @property {Track} track `world_from_local`.
 * @property {Part[]} parts Rigid parts.
 * @property {Visibility[]} visibility Changes of visibility.
 * @property {Splats} splats Its splats.
 * @property {Deformation | null} deformation Splats that move in the local frame.
 * @property {Samples | null} opacities Opacities over time, `[samples, count]`.
 * @property {Samples | null} harmonics Coefficients over time, `[samples, count, (degree + 1)^2, 3]`.
 */

/**
 * A pinhole camera: x right, y down, z forward; the centre of the first pixel is (0.5, 0.5).
 * @typedef {object} Camera
 * @property {number[]} size Width and height, pixels.
 * @property {number[]} focal Focal lengths, pixels.
 * @property {number[]} principal Principal point, pixels.
 * @property {Pose} pose `world_from_camera`.
 */

/**
 * A camera at a time code.
 * @typedef {Camera & { code: number }} Shot
 */

/**
 * @typedef {object} RecordedCamera
 * @property {string} name Name.
 * @property {Shot[]} samples Ascending time codes, at least one.
 */

/**
 * @typedef {object} ViewFields
 * @property {string} name Unique name.
 * @property {string} camera Name of its camera.
 * @property {'train' | 'val'} split Split.
 * @property {string} image Address of the image.
 * @property {string | null} mask Address of its mask.
 */

/**
 * An image of the capture.
 * @typedef {ViewFields & Shot} View
 */

/**
 * @typedef {object} Timeline
 * @property {number} start First time code.
 * @property {number} end Last time code.
 * @property {number} per_second Time codes per second.
 * @property {number[]} samples Time codes at which the scene was sampled.
 */

/**
 * @typedef {object} Document
 * @property {number} version 1.
 * @property {string} title Name of the file or folder.
 * @property {number[]} up Unit vector that points up in the world.
 * @property {number | null} meters_per_unit Metres per world unit.
 * @property {number[]} background Colour behind everything, in [0, 1].
 * @property {'z' | 'distance'} sort Order in which splats are blended.
 * @property {boolean} antialiased True when opacity is lowered by as much as the low-pass filter widens.
 * @property {number} [near] Near plane, world units; 0.2 where it is left out.
 * @property {Timeline} timeline The times that are played.
 * @property {Node[]} nodes Objects, and the background last.
 * @property {RecordedCamera[]} cameras Recorded cameras.
 * @property {View[]} views
 * @property {string | null} stage Stage that edits are a layer over.
 * @property {number} bytes Length of the block.
 * @property {boolean} live The scene comes from a run that goes on. Images of the capture.
 */

/**
 * How the splats are coloured.
 * @typedef {object} Look
 * @property {'color' | 'instances' | 'depth'} mode What is shown.
 * @property {number} tint How much of each splat's colour is that of its node, 0 to 1.
 * @property {boolean[]} visible By node.
 * @property {number} selected Index of the node that is marked, or -1.
 * @property {number[]} [background] Colour behind everything, in [0, 1]; that of the document where left out.
 */

/**
 * What a pixel shows.
 * @typedef {object} Picked
 * @property {number} node Index of the node with the largest blended weight; -1 where less than half of the
 *   pixel is covered.
 * @property {number[] | null} point World point at the median depth along the ray; null where `node` is -1.
 * @property {number | null} depth Camera z of that point.
 */

export {};
