"""Which topics to record, so that a recording can be read with the same options."""

from __future__ import annotations

from parallel_cal.recordings.channels import list_channels
from parallel_cal.recordings.options import ReadOptions
from parallel_cal.recordings.pose_messages import split_body

TRANSFORMS = ("/tf", "/tf_static")  # what /tf refers to may be published on the other one


def list_record_topics(options: ReadOptions, namespace: str = "") -> list[str]:
    """Return the full names of the topics that the commands read with these options.

    Topics that nobody publishes cost nothing. If the options name a topic of poses, they name all
    of them.

    Parameters
    ----------
    options
        The options with which the recording will be read: topics of channels and of images.
    namespace
        The namespace of names that do not begin with `/`.
    """
    named, poses = options.topics, list_channels("poses")
    channels = list_channels("joints", "poses", "condition", "words", "readings", among=named)
    if any(named.get(name) for name in poses):
        channels = [name for name in channels if name in named or name not in poses]
    images = [options.images] if isinstance(options.images, str) else options.images
    topics = [*(split_body(named.get(name, name))[0] for name in channels), *images]
    space = "".join(f"/{word}" for word in namespace.split("/") if word)
    full = [name if name.startswith("/") else f"{space}/{name}" for name in topics if name]
    return list(dict.fromkeys([*full, *(TRANSFORMS if TRANSFORMS[0] in full else ())]))


def make_record_command(topics: list[str], bag: str) -> list[str]:
    """Return the words of the command that records the topics.

    Every release of Jazzy takes the topics as arguments; `--topics` came with a later one.
    """
    return ["ros2", "bag", "record", "-s", "mcap", "-o", bag, *topics]
