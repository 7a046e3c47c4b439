"""Measurement -> GTSAM factor. numpy and gtsam only; keys are arguments; nothing of topograph."""
