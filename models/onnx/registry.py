"""The networks one can use: what for, by whom, on which terms, from where, and under which file name."""

from __future__ import annotations

from dataclasses import dataclass

from vggtgeo.models.onnx.contracts import CONTRACTS, Contract


@dataclass(frozen=True)
class HubFile:
    """An ONNX file that its authors publish on the Hugging Face hub. sha256: of the file, hexadecimal."""

    repository: str
    path: str
    sha256: str
    revision: str = "main"


@dataclass(frozen=True)
class Network:
    """One file of a folder of networks.

    contract: key of `CONTRACTS`. file: its name in the folder. licence, allows: of the published weights. code: the
    repository an export is made from. weights: where they are published. megabytes: of the float32 file. hub: a
    published ONNX file; None where the file must be exported.
    """

    name: str
    contract_name: str
    paper: str
    licence: str
    allows: str
    code: str
    weights: str
    megabytes: int
    hub: HubFile | None = None

    @property
    def file(self) -> str:
        return f"{self.name}.onnx"

    @property
    def contract(self) -> Contract:
        return CONTRACTS[self.contract_name]

    @property
    def role(self) -> str:
        return self.contract.role


_DINOV3 = {
    "contract_name": "dinov3",
    "paper": "Siméoni et al., DINOv3, 2025, arXiv:2508.10104",
    "licence": "DINOv3 License",
    "allows": "research and commercial use on its conditions (no military use)",
    "code": "facebookresearch/dinov3",
}
_MOGE2 = {
    "contract_name": "moge2",
    "paper": "Wang et al., MoGe-2, 2025, arXiv:2507.02546",
    "licence": "MIT",
    "allows": "any use",
    "code": "microsoft/MoGe",
}
_MAST3R = {
    "paper": "Leroy et al., MASt3R, ECCV 2024, arXiv:2406.09756",
    "licence": "CC BY-NC-SA 4.0",
    "allows": "non-commercial use only; see also the terms of its training data",
    "code": "naver/mast3r",
    "weights": "MASt3R_ViTLarge_BaseDecoder_512_catmlpdpt_metric.pth",
}

_ALL = (
    Network(
        name="vggt",
        contract_name="vggt",
        paper="Wang et al., VGGT, CVPR 2025, arXiv:2503.11651",
        licence="VGGT License",
        allows="VGGT-1B: non-commercial; VGGT-1B-Commercial: commercial use too (no military use)",
        code="facebookresearch/vggt",
        weights="hub: facebook/VGGT-1B",
        megabytes=4851,
    ),
    Network(name="dinov3", weights="hub: facebook/dinov3-vitl16 (on request)", megabytes=1214, **_DINOV3),
    Network(name="dinov3-small", weights="hub: facebook/dinov3-vits16 (on request)", megabytes=87, **_DINOV3),
    Network(
        name="moge2",
        weights="hub: Ruicheng/moge-2-vitl-normal",
        megabytes=1324,
        hub=HubFile(
            "Ruicheng/moge-2-vitl-normal-onnx",
            "model.onnx",
            "afbc4ccc3450298f3afb35b90f015f4c4f552dea21dc6470d5f7b78b77e2d751",
        ),
        **_MOGE2,
    ),
    Network(
        name="moge2-small",
        weights="hub: Ruicheng/moge-2-vits-normal",
        megabytes=141,
        hub=HubFile(
            "Ruicheng/moge-2-vits-normal-onnx",
            "model.onnx",
            "24eacb5dc7a2c54c7bc98f7de085ffbed79ad006ea5b664c2c2cdc02ff3a52f0",
        ),
        **_MOGE2,
    ),
    Network(
        name="letr",
        contract_name="letr",
        paper="Xu et al., LETR, CVPR 2021, arXiv:2101.01909",
        licence="Apache-2.0",
        allows="any use",
        code="mlpc-ucsd/LETR",
        weights="res50_stage2_focal.zip of the repository",
        megabytes=244,
    ),
    Network(
        name="mlsd",
        contract_name="mlsd",
        paper="Gu et al., M-LSD, AAAI 2022, arXiv:2106.00186",
        licence="Apache-2.0",
        allows="any use",
        code="lhwcv/mlsd_pytorch",
        weights="models/mlsd_tiny_512_fp32.pth of the repository",
        megabytes=3,
    ),
    Network(name="mast3r_encoder", contract_name="mast3r_encoder", megabytes=1214, **_MAST3R),
    Network(name="mast3r_decoder", contract_name="mast3r_decoder", megabytes=1536, **_MAST3R),
)
NETWORKS = {network.name: network for network in _ALL}
"""Every network by its name."""
