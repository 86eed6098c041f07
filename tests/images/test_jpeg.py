"""A JPEG file has the quality that was asked for, and the colours in their order."""

import io

import numpy as np
import pytest
from PIL import Image
from PIL.JpegImagePlugin import JpegImageFile

from pipeline.images.jpeg import encode


@pytest.mark.parametrize("quality", [50, 80, 95, 100])
def test_a_file_is_quantised_as_pillow_does_at_that_quality(quality: int) -> None:
    red = np.zeros((16, 16, 3), np.uint8) + np.array([200, 40, 90], np.uint8)
    theirs = io.BytesIO()
    Image.fromarray(red).save(theirs, "jpeg", quality=quality)
    ours = JpegImageFile(io.BytesIO(encode(red, quality)))
    assert ours.quantization == JpegImageFile(io.BytesIO(theirs.getvalue())).quantization
    assert np.abs(np.asarray(ours).astype(int) - red).max() < 12
