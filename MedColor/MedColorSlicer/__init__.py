"""What only Slicer can run, one part per file; nothing here is imported before Slicer shows the module.

scene         MRML nodes <-> arrays and geometry; result node; copies, never borrows
references    pictures: files, folders, colour volumes, arrays
reference_masks   what is tissue in a picture
rendering     volume rendering of a result: opacity, shading, shader
rendering_guard   repairs it after presets and re-opened scenes
rendering_show    shows a result, watched over by the guard
comparison    grey and colour side by side
cut           what is cut away in 3-D; views
light         realistic or plain light in 3-D views
view_fit      slice views and cameras fitted to the body
scene_watch   what happens in the scene while the panel is open
parameters    parameter node behind the panel, and the library settings it stands for
sequences     every time point of a sequence of volumes
tissues       segments grouped by their terminology or name
given         nodes, paths and arrays of the console and the panel -> what the library takes
logic         validate, run, publish; no widgets, no message boxes
running       a computation in a worker thread while the window stays responsive
dependencies  packages to install, by Slicer's own mechanisms, asked first
samples       Sample Data
widget        the panel: life cycle, in line with the scene
panel_run     Apply and Cancel, and where errors become messages
panel_inputs, panel_nodes, panel_smoother, panel_plan, panel_preview, panel_live, panel_volumes, panel_display   its parts
selftest      the test behind Slicer's "Reload and Test"; selftest_samples: what it needs
"""
