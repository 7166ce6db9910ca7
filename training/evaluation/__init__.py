"""How well a method relights: benchmarks, baselines, measures, and the report of them.

metrics, lpips        pictures, and series of figures, to numbers
tasks, benchmarks     what a benchmark is made of; the benchmarks in a folder
layouts               benchmarks of real photos, as others published them
synthbench, people    the renders of SynthBench, and the figures in them
methods, baselines    what is evaluated, and what needs no network
control               how a picture answers to the brush
run, results, report  a method over a benchmark; its records; JSON, Markdown, contact sheet
"""
