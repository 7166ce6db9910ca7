"""Measure how well a method relights: benchmarks, baselines, measures and reports.

metrics, lpips        measures of pictures and of series of figures
tasks, benchmarks     one pair of pictures; the benchmarks in a folder
layouts               published benchmarks of real photos
synthbench, people    renders SynthBench and its human figures
methods, baselines    the evaluated methods, and methods without a network
control               how a picture responds to the brush
run, results, report  runs a method on a benchmark; its results; JSON, Markdown, contact sheet
"""
