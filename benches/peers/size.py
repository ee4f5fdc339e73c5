#!/usr/bin/env python3
"""Size of a baked frame against SZ3 and NanoVDB at the same maximum error; writes docs/size.md.

    cargo build --release
    python3 -m venv venv && venv/bin/pip install numpy zfpy pysz zstandard
    venv/bin/python benches/peers/size.py [DATA]

DATA is the folder with `plume/` (default: $SMOKE_BAKE_DATA or ../shared/data); the peers' scripts lie beside it in
`peers/`. Needs Debian's python3-openvdb, python3-numpy (for Debian's own python3) and libnanovdb-tools.
"""
import json, os, re, subprocess, sys, tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
DATA = Path(sys.argv[1] if len(sys.argv) > 1 else os.environ.get("SMOKE_BAKE_DATA", ROOT / "../shared/data")).resolve()
PEERS = DATA.parent / "peers"
PROGRAM = ROOT / "target/release/smoke-bake"
FRAMES, ERRORS = (1020, 1040, 1060), (0.002, 0.01)


def run(*command):
    return subprocess.run([str(word) for word in command], check=True, capture_output=True, text=True).stdout


def bake(folder, *options):
    """Bakes, and gives the document that `bake --json` prints."""
    pack = folder / "plume.smoke"
    return pack, json.loads(run(PROGRAM, "bake", DATA / "plume/plume.####.vdb", "-o", pack, "--progress", "none", "--json", *options))


def rows(frame, error, folder):
    """Bits per active voxel: {name: (at rest, resident)}, and our largest error as another reader sees it."""
    pack, document = bake(folder, "--frames", frame, "--gaussians", 600, "--max-error", error)
    ours = document["frames"][0]
    unpacked, dense, decoded = folder / "ours.vdb", folder / "source.npz", folder / "ours.npz"
    run(PROGRAM, "unpack", pack, "-o", unpacked, "--progress", "none")
    source = DATA / f"plume/plume.{frame}.vdb"
    for volume, target in ((source, dense), (unpacked, decoded)):
        run("/usr/bin/python3", PEERS / "grid_to_npz.py", volume, target)
    text = run(sys.executable, PEERS / "rate_distortion.py", dense, "--vdb", source, "--max-error", error,
               "--ours", decoded, "--ours-bytes", ours["bytes_at_rest"], "--ours-resident", ours["bytes_resident"])
    found = {}
    for line in text.splitlines():
        match = re.match(r"(.+?)\s+([\d.]+|-) b at rest\s+([\d.]+|-) b resident.*max error (\S+)", line)
        if match:
            number = lambda cell: float("nan") if cell == "-" else float(cell)
            found[match[1].strip()] = (number(match[2]), number(match[3]), match[4])
    for name in ("SZ3", "NanoVDB FpN", "ours"):
        if name not in found:
            sys.exit(f"no row for {name}; what came out:\n{text}")
    return ours["active_voxels"], found


def main():
    lines = ["# Size, measured", "",
             "One frame of the plume, baked with 600 Gaussians; bits per active voxel, Gaussians and support included, against",
             "SZ3 (an error-bounded compressor without random access) and NanoVDB FpN (resident, random access), all held to",
             "the same maximum error of a density in [0, 1]. The largest error is measured by another reader (OpenVDB's) on",
             "the volume that `unpack` wrote.", "",
             "| frame | active voxels | max error | ours at rest | SZ3 | ours / SZ3 | ours resident | NanoVDB FpN | ours / FpN | largest error |",
             "|---|---|---|---|---|---|---|---|---|---|"]
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        for error in ERRORS:
            for frame in FRAMES:
                active, found = rows(frame, error, folder)
                (rest, resident, worst), sz3, fpn = found["ours"], found["SZ3"][0], found["NanoVDB FpN"][1]
                lines.append(f"| {frame} | {active:,} | {error} | **{rest:.2f}** | {sz3:.2f} | {rest / sz3:.2f} | **{resident:.2f}** | {fpn:.2f} | {resident / fpn:.2f} | {worst} |")
                print(lines[-1], flush=True)
        lines += ["", "## The whole sequence", "",
                  "All 64 frames with the defaults (1000 Gaussians, maximum error 1/510 of the largest density):", "",
                  "| every n-th frame stands alone | file, bytes | of the .vdb files | bits at rest | bits resident |", "|---|---|---|---|---|"]
        source = sum(path.stat().st_size for path in (DATA / "plume").glob("*.vdb"))
        for every in (1, 8):
            pack, document = bake(folder, "--key-every", every)
            size, active = pack.stat().st_size, sum(f["active_voxels"] for f in document["frames"])
            bits = [8 * sum(f[key] for f in document["frames"]) / active for key in ("bytes_at_rest", "bytes_resident")]
            lines.append(f"| {every} | {size:,} | {size / source:.3f} | {bits[0]:.2f} | {bits[1]:.2f} |")
            print(lines[-1], flush=True)
    lines += ["", "Made by `benches/peers/size.py` (its head says what it needs).", ""]
    (ROOT / "docs/size.md").write_text("\n".join(lines))


if __name__ == "__main__":
    main()
