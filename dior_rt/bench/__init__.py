"""Speed against error, measured side by side on the machine in front of you: `dior-rt bench`.

plan.py says what is run; run.py runs it, each time in a process of its own (worker.py); difference.py holds
pictures to the reference's; machine.py and flops.py say what the hardware could do at best; report.py keeps
all of it, tables.py and plot.py show it.
"""
