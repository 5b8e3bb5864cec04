import numpy as np
from worlds import straight_road

from shiftsim.planners.routes.lead import LightWatch
from shiftsim.world.state import LightStatus, TrafficLights


def lights(names, *statuses):
    return TrafficLights(names, np.array([statuses], np.int8))


def test_red_lights_come_in_the_order_of_the_lights_with_their_outlines():
    road = straight_road()
    first, second, other = (road.edges.index[name] for name in ("20", "21", "10"))
    watch = LightWatch(road, [first, second])
    listed = lights(("21", "10", "unknown", "20", "20"), 2, 2, 2, LightStatus.GREEN, 2)
    red = watch.at(listed.readonly())
    assert red.lanes == [second, first]
    assert other not in red.lanes
    for place, lane in enumerate(red.lanes):
        ring = red.xy[red.ptr[place] : red.ptr[place + 1]]
        np.testing.assert_array_equal(ring, road.edges.rings(lane)[0])
        np.testing.assert_array_equal(red.bounds[place], [*ring.min(axis=0), *ring.max(axis=0)])


def test_lights_are_looked_at_again_when_they_change():
    watch = LightWatch(straight_road(), range(100))
    red, green = lights(("21",), 2).readonly(), lights(("21",), 0).readonly()
    seen = watch.at(red)
    assert len(seen.lanes) == 1
    assert watch.at(red) is seen
    assert watch.at(green).lanes == []
    assert len(watch.at(red).lanes) == 1


def test_lights_that_are_written_in_place_are_noticed():
    watch, changing = LightWatch(straight_road(), range(100)), lights(("21",), 2)
    assert len(watch.at(changing).lanes) == 1
    changing.status[0, 0] = LightStatus.GREEN
    assert watch.at(changing).lanes == []
