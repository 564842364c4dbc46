"""The order of the axes of an image, found from its shape."""

from typing import Any, NamedTuple

LARGE = 32  # from so many pixels a side on, an array of this shape is taken for an image
SMALL = 8  # the smallest side of what can be read as an image
CHANNELS = (1, 3, 4)  # gray, colours, colours and opacity
FRAMES = 64  # the longest stack of frames


class ImageLayout(NamedTuple):
    """How an array [B, ...] becomes images [B, H, W, C].

    Attributes:
      order: the axes of the array, the batch apart, in the order stack, height, width, channels;
        -1 for an axis that the array does not have.
      shape: [H, W, C]; stacked frames are channels, oldest first.
      stacked: the number of stacked frames.
    """

    order: tuple[int, int, int, int]
    shape: tuple[int, int, int]
    stacked: int

    def apply(self, array: Any) -> Any:
        """Return the images of an array [B, ...] of NumPy or of jax."""
        xp = array.__array_namespace__()
        missing = [i for i, axis in enumerate(self.order) if axis < 0]
        array = array.transpose(0, *(axis + 1 for axis in self.order if axis >= 0))
        array = xp.expand_dims(array, tuple(i + 1 for i in missing))  # [B, S, H, W, C]
        if self.stacked == 1:
            return array[:, 0]
        return xp.moveaxis(array, 1, 3).reshape(len(array), *self.shape)


def find_layout(shape: tuple[int, ...], side: int) -> ImageLayout | None:
    """Return the layout of an image, or None if the shape is not that of an image.

    Images are [H, W], [H, W, C] or [C, H, W] (C frames of gray are read alike), and stacks of
    frames [S, H, W, C], [S, C, H, W] or [H, W, C, S].

    Args:
      shape: of the array, without the batch.
      side: the smallest height and width of an image.

    >>> find_layout((84, 84), 32).shape, find_layout((3, 64, 48), 32).shape
    ((84, 84, 1), (64, 48, 3))
    >>> find_layout((4, 84, 84, 3), 32).shape, find_layout((7, 7, 3), 32)
    ((84, 84, 12), None)
    """
    large = lambda *axes: all(shape[axis] >= side for axis in axes)
    middle = sorted(shape)[len(shape) // 2]
    if len(shape) == 2 and large(0, 1):
        return ImageLayout((-1, 0, 1, -1), (shape[0], shape[1], 1), 1)
    if len(shape) == 3 and shape[2] <= middle and large(0, 1):
        return ImageLayout((-1, 0, 1, 2), shape, 1)
    if len(shape) == 3 and shape[0] < middle and large(1, 2):
        return ImageLayout((-1, 1, 2, 0), (shape[1], shape[2], shape[0]), 1)
    if len(shape) == 4:
        for stack, height, width, channels in ((0, 1, 2, 3), (0, 2, 3, 1), (3, 0, 1, 2)):
            few = shape[stack] <= FRAMES and shape[channels] in CHANNELS
            if large(height, width) and few:
                size = (shape[height], shape[width], shape[stack] * shape[channels])
                return ImageLayout((stack, height, width, channels), size, shape[stack])
    return None
