"""A scorer of one's own."""


class CentreContrast:
    """Contrast of the middle of the picture: twice the standard deviation, at most 1."""

    domain = "srgb"  # or "raw"; pictures are developed only if a scorer asks for them

    def __call__(self, images, captures):  # (B, 3, H, W) in [0, 1] -> (B,)
        """Scores a batch of pictures."""
        h, w = images.shape[-2:]
        centre = images[..., h // 4 : -h // 4, w // 4 : -w // 4]
        return (2.0 * centre.std(dim=(1, 2, 3))).clamp(0.0, 1.0)
