"""Find the poses of images through pycolmap, for ``cif capture``.

Reads one job as JSON from standard input and answers with one JSON object on standard output; what pycolmap
itself prints goes to standard error, among lines ``@ WORDS`` that tell the progress.

Job: ``work`` (folder for databases), ``images`` (folder), ``masks`` (folder of ``NAME.png``, black is left
out, or null), ``names`` (images in the folder, without spaces), ``pairs`` (of indices into ``names``),
``cameras`` (``images``, indices of those that share a lens, their ``size``, and ``params`` of the lens or
null), ``model`` (of the lens), ``peak`` (threshold of features or null), ``runs`` (``mapper``, ``global`` or
``incremental``, and ``seed``), ``poses`` (null, or where images are known to be, by name: ``rotation`` as
quaternion w, x, y, z and ``translation``, camera from world), ``threads``. Features and matches are kept in
``work``, for other runs of the same ``peak``.

Answer: ``features`` (per image), ``runs``, one for each that was asked for: null, or the largest model with
its lenses, images (``camera_from_world`` as quaternion w, x, y, z and translation), points with colour and
error in pixels; and ``points`` that images with known poses see. Where pycolmap cannot be imported:
``missing``, ``python`` and ``version``.
"""

import sys

# Without the folder that the command runs in: a file there must not stand in for a module.
sys.path[:] = [path for path in sys.path if path]

import json  # noqa: E402
import os  # noqa: E402
from pathlib import Path  # noqa: E402


def tell(words):
    """Tell the progress."""
    print("@ " + words, file=sys.stderr, flush=True)


def extract_and_match(pycolmap, job, database):
    """Fill a database with features, lenses and verified matches."""
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = job["model"]
    if job["masks"]:
        reader.mask_path = job["masks"]
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.num_threads = job["threads"]
    extraction.use_gpu = False
    if job["peak"]:
        extraction.sift.peak_threshold = job["peak"]
    # An empty database, for images to be numbered in order: threads finish their features in any.
    with pycolmap.Database.open(database):
        pass
    tell("features")
    for camera in job["cameras"]:
        names = [job["names"][index] for index in camera["images"]]
        reader.camera_params = ",".join(repr(float(value)) for value in camera["params"] or [])
        mode = pycolmap.CameraMode.SINGLE
        pycolmap.import_images(database, job["images"], camera_mode=mode, image_names=names, options=reader)
        pycolmap.extract_features(
            database,
            job["images"],
            image_names=names,
            camera_mode=mode,
            reader_options=reader,
            extraction_options=extraction,
            device=pycolmap.Device.cpu,
        )
    tell("matches")
    pairs = database.with_suffix(".pairs")
    names = job["names"]
    pairs.write_text("".join(f"{names[a]} {names[b]}\n" for a, b in job["pairs"]))
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = job["threads"]
    matching.use_gpu = False
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = pairs
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = 1
    pycolmap.match_image_pairs(
        database,
        matching_options=matching,
        pairing_options=pairing,
        verification_options=verification,
        device=pycolmap.Device.cpu,
    )


def reconstruct(pycolmap, job, database, mapper, seed):
    """Return the model with most images, or None."""
    tell(f"poses, {mapper} mapper")
    pycolmap.set_random_seed(seed)
    output = database.with_suffix(f".{mapper}.{seed}")
    output.mkdir(exist_ok=True)
    if mapper == "global":
        options = pycolmap.GlobalPipelineOptions()
        mapping = pycolmap.global_mapping
    else:
        options = pycolmap.IncrementalPipelineOptions()
        # Small captures and rigs have few images.
        options.min_model_size = 3
        mapping = pycolmap.incremental_mapping
    # One thread adds in one order: the same poses at every call.
    options.num_threads = 1
    options.random_seed = seed
    models = mapping(database, job["images"], output, options)
    return max(models.values(), key=lambda model: (model.num_reg_images(), model.num_points3D()), default=None)


def triangulated(pycolmap, job, database):
    """Return the model of images whose poses are known, with the points that two or more of them see."""
    tell("points")
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
    output = database.with_suffix(".points")
    output.mkdir(exist_ok=True)
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = 1
    options.random_seed = 1
    options.triangulation.ignore_two_view_tracks = False
    return pycolmap.triangulate_points(model, database, job["images"], output, options=options)


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


def described(model):
    """Return a model as JSON."""
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
        "reprojection_px": float(model.compute_mean_reprojection_error()),
    }


def main():
    """Do the job."""
    answer = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    job = json.load(sys.stdin)
    try:
        import pycolmap
    except ImportError as error:
        json.dump({"missing": str(error), "python": sys.executable, "version": sys.version.split()[0]}, answer)
        return
    pycolmap.logging.minloglevel = 2
    peak = job["peak"] or 0
    database = Path(job["work"]) / f"features-{peak}.db"
    if not database.exists():
        extract_and_match(pycolmap, job, database)
    with pycolmap.Database.open(database) as opened:
        images = opened.read_all_images()
        features = {image.name: opened.num_keypoints_for_image(image.image_id) for image in images}
    runs = []
    for run in job["runs"]:
        model = reconstruct(pycolmap, job, database, run["mapper"], run["seed"])
        runs.append(described(model) if model else None)
    points = points_of(triangulated(pycolmap, job, database)) if job["poses"] else []
    json.dump({"features": features, "runs": runs, "points": points}, answer)
    answer.flush()


main()
