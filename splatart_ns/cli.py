"""Gaussian splats of articulated objects that can be posed: fit them to images, render and evaluate them."""

from __future__ import annotations

import contextlib
import math
import os
import shutil
import sys
import warnings
from pathlib import Path
from typing import Annotated, Literal

# A spinning OpenMP pool makes two busy processes on one machine many times slower; it is read when torch is imported.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import tyro
from rich.console import Console
from rich.progress import track

from splatart_ns.capture.procedural import OBJECTS
from splatart_ns.capture.synthesis import SynthesisOptions
from splatart_ns.errors import InputError

CONSOLE = Console()
Quality = Literal["draft", "standard", "high"]
Rasterizer = Literal["auto", "torch", "numba", "gsplat"]


def fit(
    capture: Annotated[Path, tyro.conf.Positional],
    output_dir: Path,
    quality: Quality = "standard",
    root: str | None = None,
    seed: int = 0,
    joint: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = (),
    worlds: Literal["shared", "rigid", "similar"] | None = None,
    refine_cameras: Literal["auto", "on", "off"] = "off",
    rasterizer: Rasterizer = "auto",
) -> None:
    """Fit an articulated splat to a capture: all stages, resumed after the last finished one.

    Args:
        capture: Folder of the capture.
        output_dir: Folder of the bundle; created, or continued when it holds an unfinished fit.
        quality: draft is fast, high is slow.
        root: Name of the part that the others hang on; chosen when not given.
        seed: Seed of everything random.
        joint: What you know of a joint, by the parts' names: child:parent, child:parent=revolute (or another type),
            child:parent=none (there is none) or child:parent=not-revolute.
        worlds: For states that were captured separately: rigid where the device measured lengths, similar where
            structure from motion gave each its own scale. The states are brought into the world of the first by the
            part --root, or one that is chosen. By default what the capture says.
        refine_cameras: Whether to correct the cameras' poses; auto does where the silhouettes contradict each other.
        rasterizer: auto takes gsplat on CUDA, else numba where it is installed, else torch.
    """
    _choose_rasterizer(rasterizer)
    from splatart_ns.plugin.fit import fit as run

    CONSOLE.print(f"Bundle: {run(capture, output_dir, quality, root, seed, rasterizer, joint, worlds, refine_cameras)}")


def batch(
    root: Annotated[str, tyro.conf.Positional],
    output_dir: str,
    quality: Quality = "standard",
    seed: int = 0,
    export: tuple[Literal["urdf", "mjcf", "usd", "glb", "ply"], ...] = (),
    rasterizer: Rasterizer = "auto",
    address: str | None = None,
    retry_failed: bool = False,
) -> None:
    """Fit many captures: each becomes a bundle in the output folder; run it again to do what is missing or changed.

    The exit code is 0 when all objects are done, 3 when some have failed, 4 when all have, 2 for a mistake in what was
    asked. OUTPUT_DIR/report.html and report.csv tell of every object.

    Args:
        root: A folder above captures, or a manifest: .csv or .jsonl with path, and optionally name, quality, root,
            seed, joints. Folders may be fsspec URLs (s3://, gs://).
        output_dir: A folder or an fsspec URL.
        quality: As in `splatart fit`.
        seed: As in `splatart fit`.
        export: Write these formats, too.
        rasterizer: As in `splatart fit`.
        address: Run on the Ray cluster there (auto, ray://HOST:PORT) instead of this machine's cores.
        retry_failed: Try again what has failed before.
    """
    from splatart_ns.batch.command import fit_captures

    settings = {"quality": quality, "root": None, "seed": seed, "joints": []}
    raise SystemExit(fit_captures(root, output_dir, settings, rasterizer, export, address, retry_failed, CONSOLE))


def shards(
    root: Annotated[str, tyro.conf.Positional],
    output_dir: str,
    images: int,
    shard_size: int = 1000,
    states: int = 64,
    resolution: int = 256,
    views: Literal["sphere", "hemisphere"] = "sphere",
    seed: int = 0,
    rasterizer: Rasterizer = "auto",
    address: str | None = None,
) -> None:
    """Render labelled images of many bundles at random views and configurations, as WebDataset tar shards.

    The samples are those of `splatart render --dataset`. Run it again to make what is missing or changed: a shard
    depends on its own bundles alone. Exit codes are those of `splatart batch`.

    Args:
        root: A folder or fsspec URL above bundles, as the output folder of `splatart batch`.
        output_dir: A folder or an fsspec URL, for shard-NNNNNN/images.tar.
        images: How many, of all bundles together; they take turns.
        shard_size: Images of a shard.
        states: Configurations of each bundle.
        resolution: Pixels along each side.
        views: See the objects from everywhere, or from above only.
        seed: Seed of views and configurations.
        rasterizer: As in `splatart fit`.
        address: As in `splatart batch`.
    """
    from splatart_ns.batch.command import write_shards
    from splatart_ns.batch.shards import ShardOptions

    options = ShardOptions(images, shard_size, states, resolution, views, seed)
    raise SystemExit(write_shards(root, output_dir, options, rasterizer, address, CONSOLE))


def render(
    bundle: Annotated[Path, tyro.conf.Positional],
    output: Path,
    configuration: Path | None = None,
    set: Annotated[tuple[tuple[str, ...], ...], tyro.conf.UseAppendAction] = (),
    sweep: bool = False,
    trajectory: Path | None = None,
    dataset: int | None = None,
    states: int = 2,
    views: Literal["sphere", "hemisphere"] = "sphere",
    seed: int = 0,
    channel: Literal["rgb", "depth", "accumulation", "parts"] = "rgb",
    frames: int = 60,
    fps: float = 30.0,
    resolution: int = 512,
    azimuth: float | None = None,
    elevation: float = 25.0,
    data: Path | None = None,
    camera: int = 0,
    background: tuple[float, float, float] = (1.0, 1.0, 1.0),
    rasterizer: Rasterizer = "auto",
) -> None:
    """Render a bundle in one configuration, in a sweep of each joint, along a trajectory, or as a labelled dataset.

    Args:
        bundle: Folder that `splatart fit` left.
        output: A folder for PNG frames or a dataset, or a .gif or .mp4 file.
        configuration: JSON file of joint values, as the viewer saves it; --set changes single ones.
        set: Joint values, joint=value: radians, or degrees as 30deg, or a length; joints of several freedoms take as
            many, lengths first: ball=10deg,0,5deg. Joints not named are as in state 0.
        sweep: Move one joint after the other over its observed range.
        trajectory: CSV file: a header of joint names, and a row of values a frame.
        dataset: Write a capture with ground truth: so many images with part labels and depth at random views and
            configurations. Run it again to go on, or with more to add some.
        states: Configurations of the dataset, each within the observed ranges; the images are dealt out to them.
        views: See the object of the dataset from everywhere, or from above only.
        seed: Seed of the dataset.
        channel: What to show.
        frames: Frames of each joint's sweep.
        fps: Frames per second of a film.
        resolution: Pixels along each side.
        azimuth: Degrees of the camera about z; by default it faces the moving parts.
        elevation: Degrees of the camera above the xy plane.
        data: Folder of the capture, to look through one of its cameras instead.
        camera: Number of that camera in state 0.
        background: Colour behind the object, 0 to 1.
        rasterizer: As in `splatart fit`.
    """
    from splatart_ns.bundle import animation, configurations, load
    from splatart_ns.bundle import camera as cameras
    from splatart_ns.bundle.dataset import Dataset, DatasetOptions
    from splatart_ns.bundle.dataset_capture import write_dataset
    from splatart_ns.capture.formats import load_capture

    if sweep and trajectory is not None:
        raise InputError("--sweep and --trajectory are both given; choose one.")
    _check_numbers(frames, fps, resolution, azimuth, elevation, background)
    _choose_rasterizer(rasterizer)
    splat = load(bundle)
    if dataset is not None:
        if set or sweep or not (configuration is trajectory is data is None):
            rivals = "--configuration, --set, --sweep, --trajectory and --data"
            raise InputError(f"--dataset chooses what it shows; leave out {rivals}.")
        samples = Dataset(splat, DatasetOptions(states, resolution, views, seed))
        told = write_dataset(samples, output, dataset, lambda missing: track(missing, "Images", console=CONSOLE))
        if not told:
            CONSOLE.print("note: no ground_truth.json, which cannot tell screws and joints of several freedoms")
        CONSOLE.print(f"Capture: {output}")
        return
    base = configurations.read_configuration(configuration, splat.bundle) if configuration is not None else {}
    base |= configurations.parse_settings(sum(set, ()), splat.bundle)
    if trajectory is not None:
        path = [base | q for q in configurations.read_trajectory(trajectory, splat.bundle)]
    else:
        path = configurations.sweep(splat.bundle, base, frames) if sweep else [base]
    if data is not None:
        view = cameras.capture_camera(load_capture(data), camera)
    else:
        turn = cameras.front_azimuth(splat.bundle) + math.radians(40) if azimuth is None else math.radians(azimuth)
        sphere = cameras.bounding_sphere(splat.bundle, path)
        view = cameras.orbit_camera(*sphere, turn, math.radians(elevation), resolution, resolution)
    images = animation.render_frames(splat, path, view, channel, background)
    CONSOLE.print(f"{animation.write_frames(images, output, fps)} frames: {output}")


def _check_numbers(
    frames: int,
    fps: float,
    resolution: int,
    azimuth: float | None,
    elevation: float,
    background: tuple[float, float, float],
) -> None:
    wrong = {
        "frames": (frames, "1 or more", frames < 1),
        "fps": (fps, "a number above 0, at most 1000", not 0 < fps <= 1000),
        "resolution": (resolution, "1 or more", resolution < 1),
        "azimuth": (azimuth, "a finite angle", azimuth is not None and not math.isfinite(azimuth)),
        "elevation": (elevation, "-90 to 90", not -90 <= elevation <= 90),
        "background": (background, "three numbers from 0 to 1", not all(0 <= c <= 1 for c in background)),
    }
    for name, (value, mend, is_wrong) in wrong.items():
        if is_wrong:
            raise InputError(f"--{name} is {value}; give {mend}.")


def view(
    bundle: Annotated[Path, tyro.conf.Positional],
    host: str = "127.0.0.1",
    port: int = 8080,
    rasterizer: Rasterizer = "auto",
) -> None:
    """Open a bundle in the browser: move its joints, hide parts, play a sweep, save what you see.

    Args:
        bundle: Folder that `splatart fit` left.
        host: Address to listen on; 0.0.0.0 lets other machines in, who need no password.
        port: Port of the page, 1 to 65535.
        rasterizer: As in `splatart fit`.
    """
    from splatart_ns.bundle import load
    from splatart_ns.viewer.viewer import Viewer

    if not 0 < port < 65536:
        raise InputError(f"--port is {port}; give 1 to 65535.")
    _choose_rasterizer(rasterizer)
    viewer = Viewer(load(bundle), host, port)
    CONSOLE.print(f"Open http://{host}:{port} in a browser. Ctrl-C ends.")
    with contextlib.suppress(KeyboardInterrupt):
        viewer.run()


def evaluate(bundle: Annotated[Path, tyro.conf.Positional], data: Path, rasterizer: Rasterizer = "auto") -> None:
    """Compare a bundle with a capture's ground truth and test views; writes metrics.json into the bundle.

    Args:
        bundle: Folder that `splatart fit` left.
        data: Folder of the capture.
        rasterizer: As in `splatart fit`.
    """
    _choose_rasterizer(rasterizer)
    from splatart_ns.evaluation.evaluate import evaluate as run
    from splatart_ns.evaluation.tables import format_tables

    for table in format_tables(run(bundle, data, _device())):
        CONSOLE.print(table)


def export(
    bundle: Annotated[Path, tyro.conf.Positional],
    format: tuple[Literal["urdf", "mjcf", "usd", "glb", "ply", "html"], ...],
    output: Path | None = None,
    scale: float | None = None,
    density: float = 400.0,
    limit_margin: float = 0.05,
    validate: bool = True,
) -> None:
    """Write a bundle for robot simulators, viewers and 3D programs, and open it there to check it; no GPU is needed.

    Args:
        bundle: Folder that `splatart fit` left.
        format: One or more: urdf, mjcf (MuJoCo), usd (UsdPhysics), glb (a node a part, animated), ply (all Gaussians),
            html (a page with a slider for each joint, in one file).
        output: Folder of the export; with several formats each has its folder in it. By default BUNDLE/export/FORMAT.
        scale: Metres per unit of the bundle; by default what its unit says, or 1 where it is unknown.
        density: Of the parts, filled, in kg / m^3.
        limit_margin: How much wider than the observed range joint limits are at both ends, as a share of the range.
        validate: Load what was written in the programs that read it and compare the poses of all links.
    """
    from splatart_ns.bundle import export as exports
    from splatart_ns.bundle import load_bundle

    for name, number in {"scale": scale, "density": density}.items():
        if number is not None and not 0 < number < math.inf:
            raise InputError(f"--{name} is {number}; give a number above 0.")
    if not 0 <= limit_margin < math.inf:
        raise InputError(f"--limit-margin is {limit_margin}; give a number of 0 or more.")
    formats = tuple(dict.fromkeys(format))
    if not formats:
        raise InputError("--format is empty; give one or more of urdf, mjcf, usd, glb, ply, html.")
    # What cannot be written is said before the meshes are made.
    exports.require(formats)
    folders = {form: bundle / "export" / form if output is None else output for form in formats}
    if output is not None and len(formats) > 1:
        folders = {form: output / form for form in formats}
    for folder in folders.values():
        exports.check_folder(folder)
    loaded = load_bundle(bundle)
    with CONSOLE.status(f"Meshes of {len(loaded.parts)} parts ..."):
        shapes = exports.part_shapes(loaded) if set(formats) - exports.WITHOUT_MESHES else None
    robot = exports.describe(loaded, shapes, bundle.resolve().name, scale, density, limit_margin)
    for note in robot.notes if set(formats) - {"html"} else ():  # a page has the bundle's own names, units and joints
        CONSOLE.print(f"note: {note}", markup=False)
    failed = False
    for form, folder in folders.items():
        path = exports.export(loaded, robot, form, folder)
        CONSOLE.print(f"Export: {path}", soft_wrap=True)
        for note in exports.format_notes(robot, form):
            CONSOLE.print(f"note: {note}", markup=False)
        if validate:
            checks = exports.validate(path, form, loaded, robot)
            failed |= any(check.verdict == "failed" for check in checks)
            CONSOLE.print(exports.format_checks(checks))
    if failed:
        raise SystemExit(1)


def import_capture(
    sources: Annotated[tuple[Path, ...], tyro.conf.Positional],
    output_dir: Path | None = None,
    labels: Path | None = None,
    in_place: bool = False,
) -> None:
    """Make a capture of other tools' folders: labels of annotation tools, and results of ns-process-data as states.

    Args:
        sources: Folder of a capture; or of each state, with a transforms.json each, in the states' order.
        output_dir: Folder of the new capture; it does not exist yet, or is empty.
        labels: What the annotation tool exported: COCO segmentation, YOLO polygons with data.yaml, or mask PNGs with
            _classes.csv; a file or a folder.
        in_place: Write the labels into the capture itself.
    """
    from splatart_ns.capture import label_import

    if not sources or in_place == (output_dir is not None) or (in_place and (len(sources) > 1 or labels is None)):
        raise InputError("Give --output-dir; or one capture, --labels and --in-place to write into the capture itself.")
    if len(sources) == 1 and labels is None:
        raise InputError(f"{sources[0]} alone leaves nothing to import; give --labels, or the folders of more states.")
    if in_place:
        done = label_import.import_labels(sources[0], labels)
    else:
        done = label_import.import_capture(sources, output_dir, labels)
    if done is not None:
        print(f"Labels: {done.format}, {done.labelled} of {done.frames} frames; parts: {', '.join(done.parts)}")
        if done.unmatched:
            names = ", ".join(done.unmatched[:3]) + (", ..." if len(done.unmatched) > 3 else "")
            print(f"No frame has the name of {len(done.unmatched)} labelled images: {names}")
    print(f"Capture: {output_dir or sources[0]}")


def check(
    capture: Annotated[Path, tyro.conf.Positional],
    suggest: int = 0,
    sheet: Path | None = None,
    json: bool = False,
) -> None:
    """Say what is wrong with a capture, frame by frame, and how to mend it.

    The exit code is 2 if there are errors, so that it cannot be fitted, and 0 if there are none, or warnings alone.

    Args:
        capture: Folder of the capture.
        suggest: Name so many training frames that would help most to label next.
        sheet: Write a PNG of the frames with their labels, problems marked.
        json: Print JSON instead of text.
    """
    from splatart_ns.capture.contact_sheet import write_contact_sheet
    from splatart_ns.capture.examination import as_json, as_text, examine

    if suggest < 0 or (sheet is not None and sheet.suffix.lower() != ".png"):
        raise InputError(f"--suggest is {suggest} and --sheet {sheet}; give 0 or more frames, and a .png file.")
    examination = examine(capture, suggest)
    if sheet is not None and examination.capture is not None:
        write_contact_sheet(sheet, examination.capture, examination.problems, examination.suggested)
    print(as_json(examination) if json else as_text(examination))
    if examination.errors:
        raise SystemExit(2)


def labels(bundle: Annotated[Path, tyro.conf.Positional], data: Path, output: Path) -> None:
    """Render part labels for the frames that have none, to be looked at and taken back by `splatart import --labels`.

    Args:
        bundle: Folder that `splatart fit` left.
        data: Folder of the capture that it was fitted to.
        output: A new folder for `labels`, PNGs of part ids, and `overlays`, pictures to look at.
    """
    from splatart_ns.bundle import load_bundle
    from splatart_ns.bundle.rendered_labels import write_labels
    from splatart_ns.capture.formats import load_capture

    _choose_rasterizer("auto")
    done = write_labels(load_bundle(bundle), load_capture(data), output, _device())
    print(f"Labels: {len(done)} frames in {output / 'labels'}; look at {output / 'overlays'}, first at")
    for one in done[:5]:
        print(f"  {one.state}/{one.frame.name} ({one.doubtful:.0%} of the object's pixels left unlabelled)")
    print(f"Take them: splatart import {data} --labels {output / 'labels'} --output-dir LABELLED")


def segment(
    capture: Annotated[Path, tyro.conf.Positional], prompts: Path, output: Path, model: str | None = None
) -> None:
    """Make part labels from clicks and boxes with a promptable segmenter; take them by `splatart import --labels`.

    Needs the extra `sam`, and a segmenter on this machine: nothing is downloaded.

    Args:
        capture: Folder of the capture.
        prompts: JSON file {"STATE/FRAME": {"part": {"points": [[x, y]], "not": [[x, y]], "box": [x, y, x, y]}}}, pixels
            from the image's top left corner.
        output: A new folder for PNGs of part ids.
        model: Folder of a SAM or SAM 2 for transformers, or its name in Hugging Face's cache.
    """
    from splatart_ns.capture import segmenter
    from splatart_ns.capture.formats import load_capture

    loaded, sam = load_capture(capture), segmenter.Sam(model or segmenter.DEFAULT_MODEL, _device())
    print(f"Labels: {segmenter.segment(loaded, prompts, output, sam)} frames in {output}")
    print(f"Take them: splatart import {capture} --labels {output} --output-dir LABELLED")


def synth(
    robot: Annotated[Path, tyro.conf.Positional],
    output_dir: Path,
    options: Annotated[SynthesisOptions, tyro.conf.arg(name="")],
) -> None:
    """Render a capture with ground truth from any URDF.

    Args:
        robot: The URDF file, or the name of a built-in object (see `splatart demo`), or random-SEED[-PARTS]
            for a random one.
        output_dir: A folder that does not exist yet, or is empty.
        options: How it is rendered.
    """
    from splatart_ns.capture.procedural import is_object_name, synthesize_object
    from splatart_ns.capture.synthesis import synthesize

    if is_object_name(str(robot)) and not robot.exists():
        synthesize_object(str(robot), output_dir, options)
    else:
        synthesize(robot, output_dir, options)
    CONSOLE.print(f"Capture: {output_dir}")


def demo(output_dir: Path = Path("demo"), object: Literal[OBJECTS] = "hinge", quality: Quality = "standard") -> None:
    """Make a capture of a built-in object, fit it, compare it with the truth and render a sweep. No download.

    Args:
        output_dir: Folder for the capture, the bundle and the film.
        object: The built-in object.
        quality: Of the fit.
    """
    from splatart_ns.capture.procedural import synthesize_object

    capture, bundle = output_dir / "capture", output_dir / "bundle"
    if not (capture / "ground_truth.json").exists():
        shutil.rmtree(capture, ignore_errors=True)
        options = SynthesisOptions(train_views=30, resolution=192)
        CONSOLE.print(f"Rendering a capture of the built-in {object} ...")
        synthesize_object(object, capture, options)
    fit(capture, bundle, quality)
    evaluate(bundle, capture)
    render(bundle, output_dir / "sweep.gif", sweep=True, frames=40, fps=20, resolution=256, azimuth=-50)
    CONSOLE.print(f"Look at {output_dir / 'sweep.gif'}; the bundle is {bundle}")


def _choose_rasterizer(rasterizer: Rasterizer) -> None:
    import torch

    from splatart_ns.rasterize.rasterization import default_backend, set_backend

    set_backend(rasterizer)
    if default_backend() == "torch" and _device() == "cpu":
        torch.set_num_threads(1)  # its operations are so small that waking a second thread takes longer


def _device() -> str:
    import torch

    return "cuda" if torch.cuda.is_available() else "cpu"


def main() -> None:
    """Run the command line. A user's mistake gets one sentence and exit code 2."""
    sys.stdout.reconfigure(errors="backslashreplace")  # file names need not be UTF-8
    # Nerfstudio's own, which its users cannot mend.
    warnings.filterwarnings("ignore", category=FutureWarning)
    warnings.filterwarnings("ignore", message="Converting a tensor with requires_grad=True")
    commands = {"fit": fit, "render": render, "view": view, "eval": evaluate, "check": check, "import": import_capture}
    commands |= {"labels": labels, "segment": segment}
    commands |= {"batch": batch, "shards": shards, "export": export, "synth": synth, "demo": demo}
    try:
        tyro.extras.subcommand_cli_from_dict(commands, prog="splatart", description=__doc__)
        sys.stdout.flush()
    except BrokenPipeError:  # as of `splatart check CAPTURE | head`; what is left to print has nowhere to go
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        raise SystemExit(141) from None
    except InputError as error:
        message = str(error)
        print(f"error: {message}" + ("" if message.endswith(".") else "."), file=sys.stderr)
        raise SystemExit(2) from None
    except OSError as error:
        if error.filename is None:
            raise
        mend = "check the path, its permissions and the space on the disk"
        print(f"error: {error.filename}: cannot be read or written ({error.strerror}); {mend}.", file=sys.stderr)
        raise SystemExit(2) from None
    except KeyboardInterrupt:
        print("Interrupted. An unfinished fit or batch goes on when it is started again.", file=sys.stderr)
        raise SystemExit(130) from None
