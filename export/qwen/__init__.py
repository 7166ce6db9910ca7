"""Export Qwen-Image-Edit with LoRAs from diffusers' files to a bundle that runs without torch.

weights.py      reads safetensors one tensor at a time and merges LoRAs
lora.py         reads LoRA files with the keys of diffusers, peft and Kohya
graph.py        writes one ONNX graph and its weights in a precision
transformer.py  the graphs of the image transformer, one per block
text.py         the graphs of the vision-language encoder, one per layer
vae.py          the image autoencoder for single pictures
bundle.py       the export: combines all of the above into one bundle and measures it
errors.py       measures the error of a precision after one step and after all steps
"""
