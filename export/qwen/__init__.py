"""Qwen-Image-Edit with LoRAs, from diffusers' files to a bundle that runs without torch.

weights.py      safetensors, shard by shard, tensor by tensor; LoRAs merged on the way
lora.py         LoRA files in diffusers', peft's and Kohya's keys
graph.py        writes one ONNX graph and its weights, in the precision asked for
transformer.py  the graphs of the image transformer, one a block
text.py         the graphs of the vision-language encoder, one a layer
vae.py          the image autoencoder, as a network on single pictures
bundle.py       the export: all of the above into one bundle, measured
errors.py       what a precision costs, after one step and after all
"""
