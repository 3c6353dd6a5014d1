"""Networks of the released layout in plain torch layers, written down without our code."""

import torch
import torch.nn.functional as F
from torch import nn


class ExposureNet(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.bias = nn.Parameter(torch.tensor([0.001, 0.002, 0.003, 0.004]))
        self.linear = nn.Linear(1, 1, bias=False)
        nn.init.constant_(self.linear.weight, 0.97)


class Holder(nn.Module):
    """A module with one entry, whose name and class the layout wants."""

    def __init__(self, name: str, entry: nn.Module) -> None:
        super().__init__()
        setattr(self, name, entry)


def level(inputs: int, outputs: int) -> nn.Module:
    layers: list[nn.Module] = []
    for channels in (inputs, outputs):
        layers += [nn.Conv2d(channels, outputs, 3, padding=1), nn.BatchNorm2d(outputs), nn.ReLU()]
    return Holder("conv", Holder("conv", nn.Sequential(*layers)))


def lower(inputs: int, outputs: int) -> nn.Module:
    return Holder("mpconv", nn.Sequential(nn.MaxPool2d(2), level(inputs, outputs).conv))


class UNet(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.inc = level(8, 64)
        self.down1, self.down2 = lower(64, 128), lower(128, 256)
        self.down3, self.down4 = lower(256, 512), lower(512, 512)
        self.up1, self.up2 = level(1024, 256), level(512, 128)
        self.up3, self.up4 = level(256, 64), level(128, 64)
        self.outc = Holder("conv", nn.Conv2d(64, 4, 1))

    def forward(self, x):
        skips = [self.inc.conv.conv(x)]
        for down in (self.down1, self.down2, self.down3, self.down4):
            pool, double = down.mpconv
            skips.append(double.conv(pool(skips[-1])))
        x = skips.pop()
        for up in (self.up1, self.up2, self.up3, self.up4):
            x = F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=True)
            x = up.conv.conv(torch.cat([skips.pop(), x], dim=1))
        return self.outc.conv(x)


class Norm(nn.Module):
    def __init__(self, channels: int) -> None:
        super().__init__()
        self.norm = nn.InstanceNorm2d(channels)
        self.style = Holder("linear", nn.Linear(2, 2 * channels))
        with torch.no_grad():  # weights of training are small: apertures are as large as 256
            self.style.linear.weight.mul_(0.02)
            self.style.linear.bias[:channels] = 1.0

    def forward(self, x, p):
        scale, shift = self.style.linear(p)[:, :, None, None].chunk(2, dim=1)
        return scale * self.norm(x) + shift


class conv_block(nn.Module):
    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.conv1, self.norm1 = nn.Conv2d(inputs, outputs, 3, padding=1), Norm(outputs)
        self.conv2, self.norm2 = nn.Conv2d(outputs, outputs, 3, padding=1), Norm(outputs)

    def forward(self, x, p):
        x = self.norm1(self.conv1(x), p).relu()
        return self.norm2(self.conv2(x), p).relu()


class up_conv(nn.Module):
    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.up = nn.Upsample(scale_factor=2)
        self.conv, self.norm = nn.Conv2d(inputs, outputs, 3, padding=1), Norm(outputs)

    def forward(self, x, p):
        return self.norm(self.conv(self.up(x)), p).relu()


class Attention_block(nn.Module):
    def __init__(self, width: int, inner: int) -> None:
        super().__init__()
        for name in ("W_g_{}1", "W_x_{}1", "W_g_{}2", "W_x_{}2"):
            setattr(self, name.format("conv"), nn.Conv2d(width, inner, 1))
            setattr(self, name.format("norm"), Norm(inner))
        self.psi_conv, self.psi_norm = nn.Conv2d(inner, 1, 1), Norm(1)
        self.conv_down = nn.Conv2d(inner, inner // 4, 1, bias=False)
        self.conv_up = nn.Conv2d(inner // 4, width, 1, bias=False)

    def forward(self, g, x, p):
        joint = (self.W_g_norm1(self.W_g_conv1(g), p) + self.W_x_norm1(self.W_x_conv1(x), p)).relu()
        place = self.psi_norm(self.psi_conv(joint), p).sigmoid()
        mean = self.W_g_norm2(self.W_g_conv2(g), p) + self.W_x_norm2(self.W_x_conv2(x), p)
        mean = F.adaptive_avg_pool2d(mean, 1)
        return x * place * self.conv_up(self.conv_down(mean).relu()).sigmoid()


class AttenUnet_style(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        widths = (32, 64, 128, 256, 512)
        for level, (inputs, width) in enumerate(zip((6, *widths), widths, strict=False), start=1):
            setattr(self, f"Conv{level}", conv_block(inputs, width))
        for level, inner in ((5, 128), (4, 64), (3, 32), (2, 32)):
            width = widths[level - 2]
            setattr(self, f"Up{level}", up_conv(2 * width, width))
            setattr(self, f"Att{level}", Attention_block(width, inner))
            setattr(self, f"Up_conv{level}", conv_block(2 * width, width))
        self.Conv = nn.Conv2d(32, 4, 1)

    def forward(self, image, p):
        planes = p[:, :, None, None].expand(-1, -1, *image.shape[2:])
        skips = [self.Conv1(torch.cat([image, planes], dim=1), p)]
        for level in (self.Conv2, self.Conv3, self.Conv4, self.Conv5):
            skips.append(level(F.max_pool2d(skips[-1], 2), p))
        x = skips.pop()
        for level in (5, 4, 3, 2):
            x = getattr(self, f"Up{level}")(x, p)
            skip = getattr(self, f"Att{level}")(x, skips.pop(), p)
            x = getattr(self, f"Up_conv{level}")(torch.cat([skip, x], dim=1), p)
        return self.Conv(x)


def make_released(seed: int = 0) -> dict[str, nn.Module]:
    """Untrained networks by the name of the demo's files, statistics of the norms not neutral."""
    generator = torch.Generator().manual_seed(seed)
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        made = {"exp_model": ExposureNet(), "unet_model": UNet(), "ap_model": AttenUnet_style()}
    for norm in (m for m in made["unet_model"].modules() if isinstance(m, nn.BatchNorm2d)):
        for tensor in (norm.running_mean, norm.running_var, norm.weight, norm.bias):
            tensor.data.copy_(0.5 + torch.rand(tensor.shape, generator=generator))
        norm.num_batches_tracked.fill_(7)
    return {name: module.eval() for name, module in made.items()}
