"""The network of the mini family: its configuration, features, layers, model and checkpoint files."""

from dior_rt.training.network.checkpoint import LORA, WEIGHTS, load_network, save_network
from dior_rt.training.network.config import Config
from dior_rt.training.network.features import BOUNCED, Features, InputChannels
from dior_rt.training.network.layers import LARGEST_LOGIT, Block, Rotation, rotate, rotations
from dior_rt.training.network.model import Mini, velocity

__all__ = [
    "BOUNCED",
    "LARGEST_LOGIT",
    "LORA",
    "WEIGHTS",
    "Block",
    "Config",
    "Features",
    "InputChannels",
    "Mini",
    "Rotation",
    "load_network",
    "rotate",
    "rotations",
    "save_network",
    "velocity",
]
