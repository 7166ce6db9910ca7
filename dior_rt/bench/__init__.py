"""Speed against error, measured side by side on the machine in front of you: `dior-rt bench`.

plan.py lists the settings. run.py runs each one in its own process (worker.py). difference.py compares
pictures with the reference's. machine.py and flops.py measure what the hardware can do at best. report.py
stores the results; tables.py and plot.py show them.
"""
