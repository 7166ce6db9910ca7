"""How well a method relights: benchmarks, baselines, measures, and the report of them.

metrics     pictures, and series of figures, to numbers
lpips       the learned distance
benchmarks  pairs of pictures from renders, SynthBench and the public layouts
synthbench  the renders of SynthBench
baselines   what needs no network
control     how a picture answers to the brush
run         a method over a benchmark
report      JSON, Markdown, contact sheet
"""
