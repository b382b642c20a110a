"""A simulator's loop around a moving mirror: `python tools/moving_mirror.py [STAGE] [MIRROR] [DEVICE]`.

Each step the mirror gets a pose, as a physics engine would give it; what it shows stays on the device.
"""

import dataclasses
import sys
from pathlib import Path

import numpy as np

import warp_reflect as wr

STAGE = Path(__file__).resolve().parents[1] / "usd_scenes" / "sphere_on_checker.usda"


def with_pose(scene: wr.Scene, path: str, world_from_object: np.ndarray) -> wr.Scene:
    """The scene with one prim elsewhere; once it is marked as what moves, all that does not is shared with the scene before."""
    at = {
        "world_from_object": world_from_object.copy(),
        "moves": True,
        "mover": path,
    }  # the scene before keeps its own pose
    known = scene.source_data.instances
    placed = [dataclasses.replace(x, **at) if x.prim_path == path else x for x in known]
    return wr.Scene(dataclasses.replace(scene.source_data, instances=placed), scene.device, earlier=scene)


def main(stage=STAGE, mirror="/World/Mirror", device="cpu", steps=4) -> wr.Frame:
    """Move the mirror along x and tell how far what it shows moved on the screen."""
    scene = wr.load_stage(str(stage), device=device)
    plan = wr.make_plan(scene, size=(320, 180))
    pose = next(each.world_from_object for each in scene.data.instances if each.prim_path == mirror).copy()
    frame = None
    for step in range(steps):
        scene = with_pose(scene, mirror, pose)
        frame = wr.render_frame(scene, plan, previous=frame)
        motion = frame.device_array("reflectionMotion")  # no copy; torch.from_dlpack(motion) or cupy.asarray(motion)
        longest = np.linalg.norm(motion.numpy(), axis=-1).max()
        print(f"step {step}: {int((frame['reflectedId'] > 0).sum())} mirror pixels, moved by up to {longest:.2f} px")
        pose[0, 3] += 0.02
    return frame


if __name__ == "__main__":
    main(*sys.argv[1:4])
