"""A render command as a job that farms understand."""

from __future__ import annotations

import os

FRAMES_PER_TASK = 10  # a task reads the stage once; of a failed one this much is done again
NOTICE_SECONDS = 120  # for the frame at hand, when a task is cancelled


def openjd_template(
    stage: str, outputs: list[str], frames: str | None, count: int, options: list[str]
) -> dict[str, object]:
    """The command as an Open Job Description template: tasks of consecutive frames, each resumable.

    Args:
        stage: The stage's file.
        outputs: The outputs, with a place for the frame number.
        frames: The frame specification; None: the stage's first alone.
        count: How many frames that is.
        options: All other options, as tokens.

    Source: Open Job Description, 2023-09 template schemas (github.com/OpenJobDescription/openjd-specifications).
    """
    parts = -(-count // FRAMES_PER_TASK)
    parameters = [_path("Stage", stage, "IN", "USD stage")]
    parameters += [
        _path(f"Output{k}", name, "OUT", "Files to write; #### is the frame number")
        for k, name in enumerate(outputs, 1)
    ]
    args = ["render", "{{Param.Stage}}", *(f"{{{{Param.Output{k}}}}}" for k in range(1, len(outputs) + 1))]
    step: dict[str, object] = {"name": "Render"}
    if frames is not None:
        parameters.append(_parameter("Frames", "STRING", frames, "Frames, as 1:100 or 101:109x2,120"))
        parameters.append(_parameter("Parts", "INT", parts, "Tasks the frames are cut into") | {"minValue": 1})
        # `=`: a specification may begin with a minus sign.
        args += ["--frames={{Param.Frames}}", "--part", "{{Task.Param.Part}}/{{Param.Parts}}"]
        definition = {"name": "Part", "type": "INT", "range": "1-{{Param.Parts}}"}
        step["parameterSpace"] = {"taskParameterDefinitions": [definition]}
    args += ["--resume", "--progress", "none", *options]
    cancel = {"mode": "NOTIFY_THEN_TERMINATE", "notifyPeriodInSeconds": NOTICE_SECONDS}
    step["script"] = {"actions": {"onRun": {"command": "warp-reflect", "args": args, "cancelation": cancel}}}
    return {
        "specificationVersion": "jobtemplate-2023-09",
        "name": f"warp-reflect {os.path.basename(stage)}"[:128],  # the schema's longest name
        "parameterDefinitions": parameters,
        "steps": [step],
    }


def _parameter(name: str, kind: str, default, description: str) -> dict[str, object]:
    return {"name": name, "type": kind, "default": default, "description": description}


def _path(name: str, value: str, flow: str, description: str) -> dict[str, object]:
    # Defaults of a PATH are relative to the template and may not be absolute; an absolute name is the farm's own.
    if os.path.isabs(value):
        return _parameter(name, "STRING", value, description)
    return _parameter(name, "PATH", value, description) | {"objectType": "FILE", "dataFlow": flow}
