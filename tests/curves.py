"""Reading back what a run logged."""

from tensorboard.backend.event_processing.event_accumulator import EventAccumulator


def scalars(folder):
    """{tag: [(step, value), ...]} of a run folder."""
    events = EventAccumulator(str(folder), size_guidance={"scalars": 0})
    events.Reload()
    return {tag: [(event.step, event.value) for event in events.Scalars(tag)] for tag in events.Tags()["scalars"]}
