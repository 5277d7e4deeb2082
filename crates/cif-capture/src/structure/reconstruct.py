"""Find the poses of images through pycolmap, for ``cif capture``.

Reads one job as a line of JSON from standard input and answers with one JSON object on standard output.
Standard input stays open as long as the caller lives; where it closes before the answer, this program ends.
What pycolmap itself prints goes to standard error, among lines ``@ DONE TOTAL WORDS`` that show the progress.

Job: ``kept`` (folder for features and matches of this and later jobs), ``work`` (folder for the rest),
``images`` and ``masks`` (folders of the images by ``names``, and of ``NAME.png``, black is left out, or null),
``pictures`` (folder of the same images by ``keys``, which are names made of their content), ``matched`` (name
made of what matches depend on), ``verified`` (name made of what their verification depends on), ``side``
(pixels of the larger side that features are looked for on), ``peak`` (threshold of features or null), ``pairs``
(of indices into ``names``; without any, only the features are counted), ``cameras`` (``images``, indices of
those that share a lens, their ``size``, and ``params`` of the lens or null), ``model`` (of the lens), ``runs``
(``mapper``, ``global`` or ``incremental``, and ``seed``), ``poses`` (null, or where images are known to be, by
name: ``rotation`` as quaternion w, x, y, z and ``translation``, camera from world), ``threads``.

Answer: ``features`` (per image), ``moved`` (without runs, of every pair, the median distance of matches from
the same place in the other image, as a share of the larger side, or null where there are few), ``runs``, one
for each that was asked for: null, or the largest model with its lenses, images (``camera_from_world`` as
quaternion w, x, y, z and translation), points with colour and error, mean reprojection error in pixels, and
``fitting``, the share of matches that fit its poses; and ``points`` that images with known poses see. Where
pycolmap cannot be imported: ``missing``, ``python`` and ``version``.

All but the answer is in pixels of the reduced images: COLMAP's thresholds are pixels in which features are
found. So are the errors of single points.

Two kinds of databases are kept. One holds features by the content of images, for every capture that these are
part of. The other holds what a mapper reads: images in their order, features that no mask leaves out, matches.
Threads finish in any order; images and features of the second kind are written by one, in order, so that the
poses are the same at every call, whatever was kept before.
"""

import contextlib
import ctypes
import json
import os
import signal
import sys
import threading
from pathlib import Path

# Images of every thread whose features are found at a time, and pairs that are matched at a time: what an
# interruption loses at most. Fewer would leave threads without work at the end of each part.
IMAGES = 4
PAIRS = 50

# Fewer matches than this say nothing; rays of a match may pass each other by so many pixels. Both are COLMAP's.
FEW_MATCHES = 15
MAX_ERROR_PX = 4.0

# Models that the incremental mapper begins at most, each with another pair of images; the largest is taken.
MODELS = 3

# Tracks of every image that the global mapper solves for; the others are added to the poses afterwards. All of
# them, five times as many, gave the same poses within 0.01 % in three times the time.
TRACKS = 300


def progress(done, total, words):
    """Show the progress."""
    print("@", done, total, words, file=sys.stderr, flush=True)


def in_parts(job, things, size, done, words):
    """Yield a few things at a time, and show how many are done, of which some were before."""
    total = done + len(things)
    if job["runs"] and not things:
        # The job before this one has shown it.
        return
    for start in range(0, len(things), size):
        progress(done + start, total, words)
        yield things[start : start + size]
    progress(total, total, words)


def extract(pycolmap, job):
    """Return the database that has features of all images, by the content of these."""
    # Another version may find other features.
    name = f"features-{pycolmap.__version__}-{job['side']}-{job['peak'] or 0}.db"
    database = Path(job["kept"]) / name
    keys = sorted(set(job["keys"]))
    with pycolmap.Database.open(database) as opened:
        found = {image.name for image in opened.read_all_images() if opened.exists_descriptors(image.image_id)}
    missing = [key for key in keys if key not in found]
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads = job["threads"]
    options.use_gpu = False
    options.max_image_size = job["side"]
    if job["peak"]:
        options.sift.peak_threshold = job["peak"]
    done = len(keys) - len(missing)
    for part in in_parts(job, missing, IMAGES * job["threads"], done, "features of images"):
        pycolmap.extract_features(
            database,
            job["pictures"],
            image_names=part,
            camera_mode=pycolmap.CameraMode.PER_IMAGE,
            extraction_options=options,
            device=pycolmap.Device.cpu,
        )
    return database


def reduced(job, camera):
    """Return the size of the images of a camera that features are looked for on, as a share of their size."""
    return min(1.0, job["side"] / max(camera["size"]))


def seen(pycolmap, job, name, keypoints):
    """Return which features of an image no mask leaves out."""
    mask = Path(job["masks"] or "") / f"{name}.png"
    if not job["masks"] or not mask.is_file():
        return slice(None)
    left = pycolmap.Bitmap.read(mask, as_rgb=False).to_array()
    left = left.reshape(left.shape[0], left.shape[1], -1)[:, :, 0]
    columns = keypoints[:, 0].astype(int).clip(0, left.shape[1] - 1)
    rows = keypoints[:, 1].astype(int).clip(0, left.shape[0] - 1)
    return left[rows, columns] > 0


def collect(pycolmap, job, features):
    """Return the database of images in order, with features and matches found before."""
    kept = Path(job["kept"])
    name = f"matches-{pycolmap.__version__}-{job['matched']}"
    database = kept / f"{name}-{job['verified']}.db"
    if database.exists():
        return database
    others = sorted(kept.glob(f"{name}-*.db"))
    # Whole, or not there.
    filled = database.with_suffix(".part")
    filled.unlink(missing_ok=True)
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = job["model"]
    # An empty database, for images to be numbered in order.
    with pycolmap.Database.open(filled):
        pass
    for camera in job["cameras"]:
        reader.camera_params = ",".join(repr(float(value)) for value in camera["params"] or [])
        pycolmap.import_images(
            filled,
            job["images"],
            camera_mode=pycolmap.CameraMode.SINGLE,
            image_names=[job["names"][index] for index in camera["images"]],
            options=reader,
        )
    names, keys = job["names"], dict(zip(job["names"], job["keys"], strict=True))
    shares = {names[index]: reduced(job, camera) for camera in job["cameras"] for index in camera["images"]}
    with (
        pycolmap.Database.open(filled) as opened,
        pycolmap.Database.open(features) as source,
        pycolmap.DatabaseTransaction(opened),
    ):
        numbers = {image.name: image.image_id for image in source.read_all_images()}
        own = {}
        for image in opened.read_all_images():
            own[image.name] = image.image_id
            number = numbers[keys[image.name]]
            keypoints = source.read_keypoints(number)
            taken = seen(pycolmap, job, image.name, keypoints)
            descriptors = source.read_descriptors(number)
            descriptors.data = descriptors.data[taken]
            keypoints = keypoints[taken]
            keypoints[:, :2] *= shares[image.name]
            opened.write_keypoints(image.image_id, keypoints)
            opened.write_descriptors(image.image_id, descriptors)
        for camera in job["cameras"]:
            lens = opened.read_image_with_name(names[camera["images"][0]]).camera_id
            lens = opened.read_camera(lens)
            lens.rescale(reduced(job, camera))
            opened.update_camera(lens)
        missing = {pycolmap.image_pair_to_pair_id(own[names[a]], own[names[b]]) for a, b in job["pairs"]}
        for other in others:
            with pycolmap.Database.open(other) as matched:
                for pair, matches in zip(*matched.read_all_matches(), strict=True):
                    if pair in missing:
                        missing.remove(pair)
                        opened.write_matches(*pycolmap.pair_id_to_image_pair(pair), matches)
    filled.replace(database)
    return database


def match(pycolmap, job, database):
    """Fill a database with verified matches."""
    names, listed = job["names"], Path(job["work"]) / "pairs.txt"
    with pycolmap.Database.open(database) as opened:
        own = {image.name: image.image_id for image in opened.read_all_images()}
        missing = [
            (names[a], names[b])
            for a, b in job["pairs"]
            if not opened.exists_two_view_geometry(own[names[a]], own[names[b]])
        ]
    options = pycolmap.FeatureMatchingOptions()
    options.num_threads = job["threads"]
    options.use_gpu = False
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = listed
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = 1
    done = len(job["pairs"]) - len(missing)
    for part in in_parts(job, missing, PAIRS, done, "matches of pairs of images"):
        listed.write_text("".join(f"{a} {b}\n" for a, b in part))
        pycolmap.match_image_pairs(
            database,
            matching_options=options,
            pairing_options=pairing,
            verification_options=verification,
            device=pycolmap.Device.cpu,
        )


def reconstruct(pycolmap, job, database, mapper, seed):
    """Return the model with most images, or None."""
    pycolmap.set_random_seed(seed)
    # No images lie there: colours are those of the images at their own size, and are taken afterwards.
    output = Path(job["work"]) / f"{mapper}.{seed}"
    output.mkdir(exist_ok=True)
    images = len(job["names"])
    if mapper == "global":
        options = pycolmap.GlobalPipelineOptions()
        options.mapper.track_required_tracks_per_view = TRACKS
        # It has no count of its own; its log names its steps.
        level, pycolmap.logging.minloglevel = pycolmap.logging.minloglevel, 0
        mapping, callbacks = pycolmap.global_mapping, {}
    else:
        options = pycolmap.IncrementalPipelineOptions()
        # Small captures and rigs have few images.
        options.min_model_size = 3
        # A model that begins with a bad pair of images may hold no more than these: others are begun then, but
        # not one for every few images of a video that are left out.
        options.max_num_models = MODELS
        options.extract_colors = False
        level, mapping, registered = pycolmap.logging.minloglevel, pycolmap.incremental_mapping, [0]

        def show(count):
            registered[0] = count
            progress(min(count, images), images, "poses of images, incremental mapper")

        show(0)
        callbacks = {
            "initial_image_pair_callback": lambda: show(2),
            "next_image_callback": lambda: show(registered[0] + 1),
        }
    # One thread adds in one order: the same poses at every call.
    options.num_threads = 1
    options.random_seed = seed
    try:
        models = mapping(database, output, output, options, **callbacks)
    finally:
        pycolmap.logging.minloglevel = level
    return max(models.values(), key=lambda model: (model.num_reg_images(), model.num_points3D()), default=None)


def triangulated(pycolmap, job, database):
    """Return the model of images whose poses are known, with the points that two or more of them see."""
    progress(0, 0, "points")
    import numpy

    model = pycolmap.Reconstruction()
    with pycolmap.Database.open(database) as opened:
        for camera in opened.read_all_cameras():
            model.add_camera_with_trivial_rig(camera)
        for image in opened.read_all_images():
            pose = job["poses"][image.name]
            w, x, y, z = pose["rotation"]
            rotation = pycolmap.Rotation3d(numpy.array([x, y, z, w]))
            place = pycolmap.Rigid3d(rotation, numpy.array(pose["translation"]))
            known = pycolmap.Image(name=image.name, camera_id=image.camera_id, image_id=image.image_id)
            model.add_image_with_trivial_frame(known, place)
    output = Path(job["work"]) / "points"
    output.mkdir(exist_ok=True)
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = 1
    options.random_seed = 1
    options.triangulation.ignore_two_view_tracks = False
    options.extract_colors = False
    return pycolmap.triangulate_points(model, database, output, output, options=options)


def fitting(pycolmap, database, model):
    """Return the share of verified matches whose rays meet by the poses of a model."""
    import numpy

    rays, places, focals = {}, {}, {}
    with pycolmap.Database.open(database) as opened:
        for image in model.images.values():
            if image.has_pose:
                camera = model.cameras[image.camera_id]
                keypoints = opened.read_keypoints(image.image_id)[:, :2]
                rays[image.image_id] = numpy.c_[camera.cam_from_img(keypoints), numpy.ones(len(keypoints))]
                places[image.image_id] = image.cam_from_world()
                focals[image.image_id] = camera.mean_focal_length()
        pairs, geometries = opened.read_two_view_geometries()
    fit = count = 0
    for pair, geometry in zip(pairs, geometries, strict=True):
        a, b = pycolmap.pair_id_to_image_pair(pair)
        matches = geometry.inlier_matches
        if a not in rays or b not in rays or len(matches) < FEW_MATCHES:
            continue
        between = (places[b] * places[a].inverse()).matrix()
        x, y, z = between[:, 3] / max(numpy.linalg.norm(between[:, 3]), 1e-12)
        essential = numpy.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ between[:, :3]
        of_a, of_b = rays[a][matches[:, 0]], rays[b][matches[:, 1]]
        to_b, to_a = of_a @ essential.T, of_b @ essential
        # Sampson's distance.
        slope = (to_b[:, :2] ** 2).sum(1) + (to_a[:, :2] ** 2).sum(1)
        apart = numpy.abs((of_b * to_b).sum(1)) / numpy.sqrt(numpy.maximum(slope, 1e-24))
        fit += int((apart * 0.5 * (focals[a] + focals[b]) < MAX_ERROR_PX).sum())
        count += len(matches)
    return fit / max(count, 1)


def moved(pycolmap, job, database):
    """Return how far matches of every pair are from the same place in the other image."""
    import numpy

    names, median = job["names"], {}
    with pycolmap.Database.open(database) as opened:
        images = {image.name: image.image_id for image in opened.read_all_images()}
        keypoints = {number: opened.read_keypoints(number)[:, :2] for number in images.values()}
        for pair, matches in zip(*opened.read_all_matches(), strict=True):
            a, b = pycolmap.pair_id_to_image_pair(pair)
            if len(matches) >= FEW_MATCHES:
                apart = keypoints[a][matches[:, 0]] - keypoints[b][matches[:, 1]]
                median[pair] = float(numpy.median(numpy.linalg.norm(apart, axis=1)))
    side = {images[names[k]]: max(c["size"]) * reduced(job, c) for c in job["cameras"] for k in c["images"]}
    numbers = [(images[names[a]], images[names[b]]) for a, b in job["pairs"]]
    found = [median.get(pycolmap.image_pair_to_pair_id(a, b)) for a, b in numbers]
    return [None if m is None else m / side[a] for (a, _), m in zip(numbers, found, strict=True)]


def restored(job, model):
    """Bring the lenses and features of a model to the size of the images, and colour its points; the share."""
    smallest = 1.0
    for camera in job["cameras"]:
        share = reduced(job, camera)
        smallest = min(smallest, share)
        names = {job["names"][index] for index in camera["images"]}
        images = [image for image in model.images.values() if image.name in names]
        for image in images:
            for point in image.points2D:
                point.xy = point.xy / share
        if images:
            model.cameras[images[0].camera_id].rescale(*camera["size"])
    model.extract_colors_for_all_images(job["images"], num_threads=job["threads"])
    return smallest


def points_of(model):
    """Return the points of a model as JSON."""
    return [
        {
            "position": [float(value) for value in point.xyz],
            "color": [int(value) for value in point.color],
            "error": float(point.error),
            "images": len({element.image_id for element in point.track.elements}),
        }
        for _, point in sorted(model.points3D.items())
    ]


def described(pycolmap, job, database, model):
    """Return a model as JSON."""
    share = fitting(pycolmap, database, model)
    error = float(model.compute_mean_reprojection_error()) / restored(job, model)
    images = {}
    for image in model.images.values():
        if image.has_pose:
            pose = image.cam_from_world()
            x, y, z, w = (float(value) for value in pose.rotation.quat)
            images[image.name] = {
                "camera": image.camera_id,
                "rotation": [w, x, y, z],
                "translation": [float(value) for value in pose.translation],
                "points": int(image.num_points3D),
            }
    cameras = {
        str(number): {
            "model": camera.model.name,
            "width": camera.width,
            "height": camera.height,
            "params": [float(value) for value in camera.params],
        }
        for number, camera in model.cameras.items()
    }
    return {
        "cameras": cameras,
        "images": images,
        "points": points_of(model),
        "reprojection_px": error,
        "fitting": share,
    }


def points_by_poses(pycolmap, job, database):
    """Return the points of images whose poses are known as JSON."""
    model = triangulated(pycolmap, job, database)
    restored(job, model)
    return points_of(model)


def counted(pycolmap, job, features):
    """Return how many features of every image no mask leaves out."""
    with pycolmap.Database.open(features) as opened:
        numbers = {image.name: image.image_id for image in opened.read_all_images()}
        counts = {}
        for name, key in zip(job["names"], job["keys"], strict=True):
            keypoints = opened.read_keypoints(numbers[key])
            counts[name] = len(keypoints[seen(pycolmap, job, name, keypoints)])
    return counts


def end_with_caller():
    """End this program as soon as nobody waits for its answer."""
    sys.stdin.buffer.read()
    os._exit(1)


def die_with_caller():
    """Have the system kill this program with its caller, also while pycolmap lets no thread run; Linux can."""
    with contextlib.suppress(AttributeError, OSError, TypeError):
        # PR_SET_PDEATHSIG.
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)


def main():
    """Do the job."""
    die_with_caller()
    # Ctrl-C reaches all programs of a terminal; the caller decides.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    answer = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    job = json.loads(sys.stdin.buffer.readline())
    threading.Thread(target=end_with_caller, daemon=True).start()
    try:
        import pycolmap
    except ImportError as error:
        missing = {"missing": str(error), "python": sys.executable, "version": sys.version.split()[0]}
        answer.write(json.dumps(missing))
        answer.flush()
        os._exit(0)
    pycolmap.logging.minloglevel = 2
    features = extract(pycolmap, job)
    found = {"features": counted(pycolmap, job, features)}
    if job["pairs"]:
        database = collect(pycolmap, job, features)
        match(pycolmap, job, database)
        if not job["runs"]:
            found["moved"] = moved(pycolmap, job, database)
        found["runs"] = []
        for run in job["runs"]:
            model = reconstruct(pycolmap, job, database, run["mapper"], run["seed"])
            found["runs"].append(described(pycolmap, job, database, model) if model else None)
        found["points"] = points_by_poses(pycolmap, job, database) if job["poses"] else []
    answer.write(json.dumps(found))
    answer.flush()
    # The thread above waits for input that never comes.
    os._exit(0)


main()
