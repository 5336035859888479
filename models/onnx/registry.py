"""Registry of supported networks: role, publication, licence, source and file name."""

from __future__ import annotations

from dataclasses import dataclass

from vggtgeo.models.onnx.contracts import CONTRACTS, Contract


@dataclass(frozen=True)
class HubFile:
    """An ONNX file that its authors publish on the Hugging Face hub. sha256: of the file, hexadecimal.

    The SHA-256 pins the content: a replaced file is an error. revision: the commit, if known, else a branch.
    """

    repository: str
    path: str
    sha256: str
    revision: str = "main"


@dataclass(frozen=True)
class Publication:
    """paper: where it is described. licence, allows: of the published weights. code: the repository an export reads."""

    paper: str
    licence: str
    allows: str
    code: str


@dataclass(frozen=True)
class Network:
    """One file of a folder of networks.

    contract_name: key of `CONTRACTS`. weights: where they are published. megabytes: of the float32 file. variant: of
    the export, where it is not the default one. hub: a published ONNX file; None where the file must be exported.
    part_of: the name by which it is chosen for a role, where it is one of several files.
    """

    name: str
    contract_name: str
    publication: Publication
    weights: str
    megabytes: int
    variant: str = ""
    hub: HubFile | None = None
    part_of: str = ""

    @property
    def choice(self) -> str:
        """Return the name by which it is chosen for a role."""
        return self.part_of or self.name

    @property
    def file(self) -> str:
        return f"{self.name}.onnx"

    @property
    def contract(self) -> Contract:
        return CONTRACTS[self.contract_name]

    @property
    def role(self) -> str:
        return self.contract.role

    @property
    def export_command(self) -> str:
        """Return how to make the file from the published code and weights."""
        variant = f" --variant {self.variant}" if self.variant else ""
        return f"vggtgeo models export {self.contract_name}{variant} --source CHECKOUT --checkpoint FILE -o {self.file}"


_VGGT = Publication(
    "Wang et al., VGGT, CVPR 2025, arXiv:2503.11651",
    "VGGT License",
    "VGGT-1B: non-commercial use; VGGT-1B-Commercial: commercial use too, no military use",
    "facebookresearch/vggt",
)
_DINOV3 = Publication(
    "Siméoni et al., DINOv3, 2025, arXiv:2508.10104",
    "DINOv3 License",
    "research and commercial use on its conditions, no military use",
    "facebookresearch/dinov3",
)
_MOGE2 = Publication("Wang et al., MoGe-2, 2025, arXiv:2507.02546", "MIT", "any use", "microsoft/MoGe")
_LETR = Publication("Xu et al., LETR, CVPR 2021, arXiv:2101.01909", "Apache-2.0", "any use", "mlpc-ucsd/LETR")
_MLSD = Publication("Gu et al., M-LSD, AAAI 2022, arXiv:2106.00186", "Apache-2.0", "any use", "lhwcv/mlsd_pytorch")
_MAST3R = Publication(
    "Leroy et al., MASt3R, ECCV 2024, arXiv:2406.09756",
    "CC BY-NC-SA 4.0",
    "non-commercial use only; see also the terms of its training data",
    "naver/mast3r",
)
_ALIKE = Publication(
    "Zhao et al., ALIKE, IEEE TMM 2022, arXiv:2112.02906", "BSD-3-Clause", "any use", "Shiaoming/ALIKE"
)
_XFEAT = Publication(
    "Potje et al., XFeat, CVPR 2024, arXiv:2404.19174", "Apache-2.0", "any use", "verlab/accelerated_features"
)
_MAST3R_WEIGHTS = "MASt3R_ViTLarge_BaseDecoder_512_catmlpdpt_metric.pth, linked in the repository"

_ALL = (
    Network("vggt", "vggt", _VGGT, "facebook/VGGT-1B on the hub", 4851),
    Network("dinov3", "dinov3", _DINOV3, "ViT-L/16 distilled, on request from the authors", 1214),
    Network("dinov3-small", "dinov3", _DINOV3, "ViT-S/16 distilled, on request from the authors", 87, "vits16"),
    Network(
        "moge2",
        "moge2",
        _MOGE2,
        "Ruicheng/moge-2-vitl-normal on the hub",
        1324,
        hub=HubFile(
            "Ruicheng/moge-2-vitl-normal-onnx",
            "model.onnx",
            "afbc4ccc3450298f3afb35b90f015f4c4f552dea21dc6470d5f7b78b77e2d751",
        ),
    ),
    Network(
        "moge2-small",
        "moge2",
        _MOGE2,
        "Ruicheng/moge-2-vits-normal on the hub",
        141,
        "vits",
        HubFile(
            "Ruicheng/moge-2-vits-normal-onnx",
            "model.onnx",
            "24eacb5dc7a2c54c7bc98f7de085ffbed79ad006ea5b664c2c2cdc02ff3a52f0",
            "e50ffda41565591092adea54c6ac83d6212e1e23",
        ),
    ),
    Network("letr", "letr", _LETR, "stage 2 with ResNet-50, linked in the repository", 244),
    Network("mlsd", "mlsd", _MLSD, "models/mlsd_tiny_512_fp32.pth in the repository", 3),
    Network("mast3r_encoder", "mast3r_encoder", _MAST3R, _MAST3R_WEIGHTS, 1214, part_of="mast3r"),
    Network("mast3r_decoder", "mast3r_decoder", _MAST3R, _MAST3R_WEIGHTS, 1536, part_of="mast3r"),
    Network("alike", "alike", _ALIKE, "models/alike-n.pth in the repository", 2),
    Network("alike-tiny", "alike", _ALIKE, "models/alike-t.pth in the repository", 1, "tiny"),
    Network("xfeat", "xfeat", _XFEAT, "weights/xfeat.pt in the repository", 3),
)
NETWORKS = {network.name: network for network in _ALL}
"""Every network by its name."""


def files_of(choice: str) -> tuple[str, ...]:
    """Return names of the networks that are chosen by one name."""
    return tuple(network.name for network in _ALL if network.choice == choice)


def players(role: str) -> tuple[str, ...]:
    """Return the names that can be chosen for a role, a field of `vggtgeo.Roles`."""
    return tuple(dict.fromkeys(network.choice for network in _ALL if role in network.contract.plays))
