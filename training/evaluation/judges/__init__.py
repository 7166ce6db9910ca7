"""Judges: what a relighting model has learnt about light, measured on photos, renders and real pairs.

models                what is judged: a bundle, and the baselines that need no network
subjects, painting    photos with marked places; strokes for them
changes               what a judge reads off a picture before and after
material              does the estimated Lumi map hold the photo's colours
objects, form         does drawn light end at an object's border; does it follow shapes
slope, far            does light follow the brush, and stay near it
identity              does the photo's own light give the photo
added                 one lamp added on renders
ratio                 real pairs, driven by the true ratio of their light
realbench             rendered pairs that training never sees, scored with the other benchmarks
sheet                 lighting ideas on real photos, for people to look at
panel                 the judges by name, over the models, as tables
"""
