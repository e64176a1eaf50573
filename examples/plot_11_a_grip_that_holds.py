"""
A grip that holds
=================

A simulated gripper lifts a cup and holds it while its friction changes. The controller knows nothing but what the
network reads from the fingertips: it presses more as the safety margin falls, and less as it grows.
"""

import matplotlib.pyplot as plt
import numpy as np

import sliplens as sl

# %%
# The same 200 episodes for each controller: the cup gets wet where it is held. Predictions are looked up in the
# measured
# errors of the network. ``options=EpisodeOptions(rendered=True)`` of ``sliplens.grip.episodes`` closes the loop through
# pixels, and takes half a minute an episode.
grips = {
    name: sl.run_episodes("cup", name, condition="patch", episodes=200, seed=5)
    for name in ("fixed", "margin", "oracle")
}

# %%
# Force is wasted above the least that holds, and objects fall below it. `fixed` presses with one force, `oracle`
# knows the true margin.
figure, (chart, course) = plt.subplots(ncols=2, figsize=(11, 4), layout="constrained")
for name, grip in grips.items():
    excess, dropped = float(np.mean(grip.episodes.force_excess)), 100 * grip.drop_rate
    chart.plot(excess, dropped, "o", markersize=9, label=name)
    chart.annotate(f"  {name}", (excess, dropped))
chart.set(
    xlabel="Force above the least (1 = twice as much)",
    ylabel="Dropped (% of 200 episodes)",
    ylim=(-0.1, 2.5),
    xlim=(2.5, 4.8),
)
sl.plot(grips["margin"], course)
course.set_title("the first episode under margin", loc="left")
plt.show()

# %%
# :doc:`/grip` has thousands of episodes in eight conditions with their intervals, and what speaks against making more
# of it.
