"""What can be told of a JPEG without decoding it."""

_START, _END = b"\xff\xd8", b"\xff\xd9"


def is_whole(picture: bytes) -> bool:
    """Whether it begins and ends as a JPEG does; one that was torn on its way does not."""
    return picture.startswith(_START) and picture.endswith(_END)
