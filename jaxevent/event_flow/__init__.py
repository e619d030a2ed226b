"""Dense optical flow from events alone, a function of time.

flow = jaxevent.flow_from_events(recording)
mean, covariance, valid = flow([0.5])  # px/s, (px/s)^2, booleans
x, y = flow.paths(480_000, 520_000, at=500_000).carry(x, y, t)
"""

from jaxevent.event_flow.estimator import EventFlow, FlowParams, flow_from_events
from jaxevent.event_flow.paths import WindowPaths

__all__ = ["EventFlow", "FlowParams", "WindowPaths", "flow_from_events"]
