"""Map a run, export it, find a later run in it:  python examples/map_and_localize.py run.bag later.bag"""

import sys

from topograph import export_map, localize_bags, map_bags, save_map


def main(run: str, later: str) -> None:
    orchard = map_bags(run)
    print(orchard, "-", orchard.meta["verdict"], orchard.meta["why"])
    save_map(orchard, "orchard.gpkg")
    if orchard.datum is not None:
        from pathlib import Path

        export_map(orchard, Path("trees.geojson"))
    replay = localize_bags(orchard, later)
    for fix in replay.fixes[::50]:
        x, y = fix.map_T_robot[:2, 3]
        print(f"{fix.stamp_ns * 1e-9:.1f} s: x {x:.2f} m, y {y:.2f} m, risk {fix.risk:.1e}")


if __name__ == "__main__":
    main(*sys.argv[1:3])
