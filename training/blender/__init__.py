"""The data renderer: photo-like scenes in Blender's Cycles, with every light on its own.

`assets` makes the folder of models, surfaces, panoramas and people. `scene` and the modules of the scene
kinds (`rooms`, `tables`, `outdoors`, `portraits`) describe scenes as functions of a seed and that folder;
`views` chooses cameras and lamps; `cycles`, the only module that imports bpy, builds and shoots; `store`
keeps one file a view. No module here imports torch.
"""
