"""A virtual robot's body: it stands, falls, moves and feels as the real one is known to."""

import numpy as np
import pytest
from numpy.typing import NDArray
from test_agent_imu import Wire
from virtual_robots import DARWIN

from hardware_agent.config import ImuSettings
from hardware_agent.imu import Bno055
from hardware_agent.virtual.bno055 import LYING, angles
from hardware_agent.virtual.drives import AMBIENT, TICK
from hardware_agent.virtual.faults import Faults
from hardware_agent.virtual.fleet import Fleet
from hardware_agent.virtual.imu import multiply
from hardware_agent.virtual.packets import Packet
from hardware_agent.virtual.plant import Hold, Plant
from hardware_agent.virtual.robot import VirtualRobot
from hardware_agent.virtual.servo import OVERLOAD, VOLTAGE
from pup.robot import RobotDescription

Array = NDArray[np.float64]

SEEDS = (1, 2, 3, 4, 5, 6)
START = np.array(DARWIN.gait.start)
KNEE = DARWIN.joint_names.index("r_knee")
D_16 = 16 * 8 * 4 / 1000


def ticks(angle: Array) -> Array:
    return 2048 + angle / TICK


def plant(seeds: tuple[int, ...] = SEEDS, hold: Hold = Hold.NOT, pose: Array = START) -> Plant:
    """Robots at rest with torque on and the paper's gains, P 32 and D 16."""
    made = Plant.of(DARWIN, seeds)
    orders = made.drives.orders
    orders.goal[:], orders.power[:], orders.kd[:] = ticks(pose), 1.0, D_16
    made.drives.refresh()
    made.place(range(len(seeds)), hold)
    return made


def test_stands_in_the_half_squat() -> None:
    """The notes' robot stands there without drift, leaning forward by 0.126 rad."""
    robots = plant()
    robots.step(1000)
    height, place = robots.qpos[:, 2].copy(), robots.qpos[:, :2].copy()
    robots.step(3000)
    assert np.abs(robots.qpos[:, 2] - height).max() < 0.001
    assert np.abs(robots.qpos[:, :2] - place).max() < 0.003
    assert np.abs(2 * robots.qpos[:, 5] - 0.126).max() < 0.06
    assert np.abs(robots.angles - START).max() < 0.08


def test_falls_limp_without_torque() -> None:
    robots = plant()
    robots.step(500)
    robots.drives.orders.power[:] = 0.0
    robots.drives.refresh()
    robots.step(1500)
    assert np.all(robots.qpos[:, 2] < 0.25)
    assert np.abs(robots.angles[:, KNEE] - START[KNEE]).min() > 0.5


@pytest.mark.parametrize(
    ("size", "low", "high"), [(0.1, 1.2, 2.1), (0.3, 3.0, 4.2), (0.6, 3.8, 5.7)]
)
def test_steps_are_as_fast_as_on_the_real_robot(size: float, low: float, high: float) -> None:
    """Fastest mean speed over 50 ms: 2.0, 3.8-4.0 and 4.2-4.3 rad/s were measured."""
    robots = plant(hold=Hold.ROPE)
    robots.step(500)
    low_limit, high_limit = np.array([(joint.lower, joint.upper) for joint in DARWIN.joints]).T
    goal = START + size * np.where(START > 0, -1.0, 1.0)
    free = (low_limit < goal) & (goal < high_limit)
    robots.drives.orders.goal[:] = ticks(np.where(free, goal, START))
    angles = [robots.angles.copy()]
    for _ in range(8):
        robots.step(50)
        angles.append(robots.angles.copy())
    fastest = np.abs(np.diff(angles, axis=0)).max(axis=(0, 2)) / 0.05
    assert np.all((low < fastest) & (fastest < high)), fastest
    # A 0.6 rad step settles in about 0.2 s, with 5 to 50 mrad of error.
    left = np.abs(angles[5] - angles[-1])
    assert np.quantile(left, 0.95) < 0.03
    error = np.abs(angles[-1] - goal)[:, free]
    assert np.median(error) < 0.03
    assert np.quantile(error, 0.95) < 0.06


def test_steps_in_place_for_a_moment_then_falls() -> None:
    """The paper: tracking the stepping reference alone makes the robot fall at once."""
    robots, gait = plant(), DARWIN.gait
    low, high = np.array([(joint.lower, joint.upper) for joint in DARWIN.joints]).T
    fell = np.full(len(SEEDS), np.inf)
    for k in range(100):
        time = 0.03 * k
        share = min(time / gait.blend, 1.0)
        target = gait.angles(max(0.0, time - gait.blend) / gait.period)
        pose = np.clip((1 - share) * START + share * target, low, high)
        robots.drives.orders.goal[:] = ticks(pose)
        robots.step(30)
        down = np.abs(2 * robots.qpos[:, 4:6]).max(axis=1) > 0.8
        fell = np.where(down & np.isinf(fell), time, fell)
    assert np.all(fell > 0.6)
    assert np.all(fell < 3.0)


def test_knees_carry_what_they_must() -> None:
    """0.38 N m at each knee in the half-squat, says the CAD's statics."""
    robots = plant()
    robots.step(2000)
    knees = np.abs(robots.drives.moving.torque[:, [KNEE, DARWIN.joint_names.index("l_knee")]])
    # Encoders' errors press the feet against each other: robots differ.
    assert np.median(knees.mean(axis=1)) == pytest.approx(0.38, abs=0.06)


def test_play_lets_a_link_move_freely() -> None:
    robots = plant(hold=Hold.ROPE)
    robots.step(300)
    drives = robots.drives
    play = np.array([character.motors.play for character in robots.characters])
    assert np.degrees(2 * play).mean() == pytest.approx(0.33, rel=0.5)  # the data sheet
    angle, speed = robots.angles.copy(), np.zeros(robots.angles.shape)
    drives.moving.lash[:] = drives.moving.rotor[:] = 0.0
    drives.orders.goal[:] = ticks(angle + 0.1)
    assert not drives.tick(angle, speed).any()  # the rotor runs through the play first
    for _ in range(60):
        torque = drives.tick(angle, speed)
    assert np.all(torque > 0.4)
    assert np.all(np.abs(drives.moving.lash) <= play)


def test_duty_is_clipped_and_back_emf_limits_the_speed() -> None:
    robots = plant(hold=Hold.ROPE)
    robots.drives.orders.goal[:] = ticks(START)
    robots.drives.orders.goal[:, KNEE] = ticks(np.array(0.0))
    robots.step(60)
    assert np.abs(robots.drives.moving.duty[:, KNEE]) == pytest.approx(0.96, abs=0.03)
    assert np.abs(robots.drives.moving.rotor[:, KNEE]).max() < 6.0


def test_battery_sags_under_load_and_drains() -> None:
    robots = plant(hold=Hold.ROPE)
    robots.step(500)
    rest, charge = robots.drives.volts.copy(), robots.drives.charge.copy()
    robots.drives.orders.goal[:] = ticks(START + np.where(START > 0, -0.6, 0.6))
    least = rest.copy()
    for _ in range(40):
        robots.step(5)
        least = np.minimum(least, robots.drives.volts)
    assert np.all(rest - least > 0.2)
    assert np.all(robots.drives.charge < charge)


def test_a_stalled_motor_heats_up_and_weakens() -> None:
    robots = plant((1,), Hold.ROPE)
    drives = robots.drives
    drives.moving.drive[:] = 2.0
    for _ in range(6000):
        drives.heat(0.02)
    assert drives.winding.min() > drives.case.max() > AMBIENT + 3
    drives.cool()
    assert drives.winding.max() == AMBIENT


def test_the_same_seed_is_the_same_robot() -> None:
    def history(*seeds: int) -> Array:
        robots = plant(seeds)
        robots.drives.orders.goal[:] = ticks(0.9 * START)
        seen = []
        for _ in range(30):
            robots.step(20)
            imu = np.concatenate(robots.imus.read(0))
            seen.append(np.concatenate([robots.encoders()[0], robots.qpos[0], imu]))
        return np.array(seen)

    assert np.array_equal(history(7), history(7))
    assert np.array_equal(history(7), history(7, 8, 9))  # neighbours do not matter
    assert not np.array_equal(history(7)[-1], history(8)[-1])


def test_different_seeds_are_different_robots() -> None:
    robots = Plant.of(DARWIN, range(40))
    motors = [character.motors for character in robots.characters]
    for name in ("gain", "stall", "dry", "play", "bias"):
        values = np.array([getattr(motor, name) for motor in motors])
        assert values.std(axis=0).min() > 0, name
    assert len({character.mat.friction for character in robots.characters}) == 40


def test_imus_sit_slightly_askew() -> None:
    robots = plant()
    robots.step(1000)
    told = [robots.imus.read(lane)[0] for lane in range(len(SEEDS))]
    pitch = np.array([2 * turn[2] for turn in told]) - 2 * robots.qpos[:, 5]
    assert np.abs(pitch).max() < 0.1
    assert pitch.std() > 0.005


def test_imu_is_late() -> None:
    """10 to 25 ms, in the samples of 100 Hz that the fusion gives."""
    robots = plant(hold=Hold.ROPE)
    turned = np.array([0.0, 1.0, 0.0, 0.0])
    robots.qpos[:, 3:7] = turned
    seen = []
    for _ in range(4):
        robots.qpos[:, 3:7] = turned
        robots.imus.sample(robots.qpos, robots.qvel)
        seen.append([abs(robots.imus.read(lane)[0][1]) > 0.9 for lane in range(len(SEEDS))])
    assert not np.array(seen[0]).any()
    assert np.array(seen[3]).all()


@pytest.mark.parametrize("android", [True, False])
@pytest.mark.parametrize(
    ("roll", "pitch", "yaw"), [(0.2, 0.0, 0.0), (0.0, 0.5, 0.0), (0.0, 0.0, 1.0)]
)
def test_bno055_angles_follow_the_authors_signs(
    roll: float, pitch: float, yaw: float, android: bool
) -> None:
    """Darwin's roll = -euler[1], its pitch = euler[2] by Android's convention, which they had.

    Windows' turns the pitch alone; the heading turns clockwise by both.
    """
    half = np.array([roll, pitch, yaw]) / 2
    turn = np.array([np.cos(np.linalg.norm(half)), *(np.sinc(np.linalg.norm(half) / np.pi) * half)])
    heading, told_roll, told_pitch = angles(multiply(turn, LYING), android)
    sign = 1 if android else -1
    assert (-told_roll, sign * told_pitch) == pytest.approx((roll, pitch), abs=1e-9)
    assert (np.pi / 2 - yaw) % (2 * np.pi) == pytest.approx(heading, abs=1e-9)


def test_a_hand_holds_until_the_servos_do() -> None:
    robot = VirtualRobot(DARWIN, 1)
    robot.board.write(24, b"\x01")
    robot.reset()
    robot.advance(1.0)
    assert robot.pose().held == "hand"
    assert np.array_equal(robot.plant.angles[0], START)
    for servo in robot.servos:
        servo.write(24, b"\x01")
    robot.advance(0.3)
    assert robot.pose().held == "hand"
    robot.advance(1.0)
    assert robot.pose().held == "not"
    assert robot.pose().position[2] > 0.3


def test_a_reset_leaves_the_servos_orders_alone() -> None:
    fleet = Fleet(DARWIN, (1, 2))
    for _ in range(3):
        fleet.reset()
        assert np.array_equal(fleet.plant.drives.orders.goal, np.rint(ticks(np.stack([START] * 2))))
        assert np.all(fleet.plant.qpos[:, 2] > 0.3)
        fleet.command(np.stack([START] * 2), 0.3)


def test_after_a_reset_with_a_draw_nothing_of_the_past_is_left() -> None:
    """The same draw gives the same motion and readings to the last bit, another one other noise."""

    def seen(robot: VirtualRobot, past: float, draw: int) -> Array:
        orders = robot.plant.drives.orders
        orders.goal[:], orders.power[:], orders.kd[:] = ticks(START), 1.0, D_16
        robot.plant.drives.refresh()
        orders.goal[0, KNEE] += 300  # it falls
        robot.advance(past)
        orders.goal[:] = ticks(START)
        robot.reset(draw=draw)
        told = []
        for _ in range(40):
            robot.advance(1 / 33)
            orders.goal[0, KNEE] += 10
            turn, rate, force = robot.plant.imus.read(0)
            told.append(
                [*robot.plant.qpos[0], robot.plant.drives.volts[0, 0], *turn, *rate, *force]
            )
        return np.array(told)

    robot = VirtualRobot(DARWIN, seed=3)
    first, second = seen(robot, 0.517, 7), seen(robot, 1.2, 7)
    assert np.array_equal(first, second)
    assert np.array_equal(first, seen(VirtualRobot(DARWIN, seed=3), 0.1, 7))
    other = seen(robot, 0.3, 8)
    assert np.array_equal(first[:, :-10], other[:, :-10])
    assert np.all(first[:, -10:] != other[:, -10:])


def test_a_servo_whose_plug_was_pulled_comes_back_limp() -> None:
    robot = VirtualRobot(DARWIN, 1)
    robot.board.write(24, b"\x01")
    servo = robot.servos[KNEE]
    servo.write(24, b"\x01")
    power = robot.plant.drives.orders.power
    assert power[servo.at] == 1
    faults = Faults(robot, 1)
    faults.cause({"kind": "dead_servo", "id": servo.id})
    assert power[servo.at] == 0
    faults.clear()
    assert (power[servo.at], servo.memory.get("torque_enable")) == (0, 0)


def test_on_a_rope_the_torso_stays() -> None:
    robots = plant((1, 2), Hold.ROPE)
    before = robots.qpos[:, :7].copy()
    robots.drives.orders.goal[:] = ticks(START + 0.3)
    robots.step(500)
    assert np.abs(robots.qpos[:, :7] - before).max() < 0.01
    robots.drives.orders.power[:] = 0.0
    robots.drives.refresh()
    robots.step(1500)
    assert np.abs(robots.angles[:, KNEE]).max() < 0.25  # hanging down


def test_overload_lets_go() -> None:
    """The shutdown register's factory setting: overload and overheating."""
    robot = VirtualRobot(DARWIN, 1)
    robot.board.write(24, b"\x01")
    robot.reset(Hold.ROPE)
    servo = robot.servos[KNEE]
    servo.write(24, b"\x01")
    servo.write(30, (2048 - 700).to_bytes(2, "little"))  # against the knee's stop
    robot.advance(4.0)
    assert servo.alarms() & OVERLOAD
    assert servo.memory.get("torque_enable") == 0
    assert servo.memory.get("torque_limit") == 0
    (reply,) = robot.bus.handle(Packet(1, servo.id, 1, b"", True, 6))
    assert reply.data[4] & OVERLOAD


def test_an_empty_battery_is_told() -> None:
    robot = VirtualRobot(DARWIN, 1)
    robot.board.write(24, b"\x01")
    servo = robot.servos[0]
    servo.write(12, b"\x64")  # 10.0 V
    assert not servo.alarms()
    robot.plant.drives.charge[:] = -0.2
    robot.advance(0.1)
    assert servo.alarms() & VOLTAGE


def test_moving_speed_limits_the_goals_motion() -> None:
    robot = VirtualRobot(DARWIN, 1)
    robot.board.write(24, b"\x01")
    robot.reset(Hold.ROPE)
    servo = robot.servos[DARWIN.joint_names.index("head_pan")]
    servo.write(32, (50).to_bytes(2, "little"))  # 5.7 rpm = 0.597 rad/s
    servo.write(24, b"\x01")
    servo.write(30, (2048 + 400).to_bytes(2, "little"))
    start = servo.position
    robot.advance(0.5)
    assert (servo.position - start) * TICK == pytest.approx(0.298, abs=0.05)
    robot.advance(1.0)
    assert servo.position == pytest.approx(2448, abs=15)


def test_fleet_is_what_is_behind_the_bus() -> None:
    """The same readings, to the last bit, whether goals come by packets or by arrays."""
    fleet = Fleet(DARWIN, (5, 6))
    fleet.reset()
    robot = VirtualRobot(DARWIN, 5)
    robot.board.write(24, b"\x01")
    for servo in robot.servos:
        servo.write(26, b"\x10")
        servo.write(24, b"\x01")
    for servo, goal in zip(robot.servos, np.rint(ticks(START)), strict=True):
        servo.write(30, int(goal).to_bytes(2, "little"))
    robot.plant.drives.orders.goal[:] = np.rint(ticks(START))
    for late in robot.plant._late:
        late.clear()
    robot.release()
    robot.advance(1.0)
    imu = Bno055(ImuSettings(), Wire(robot.imu))
    assert imu.configure()
    for k in range(20):
        position, tilt = fleet.observe()
        told = [servo.read(36, 2) for servo in robot.servos]
        counts = np.array([int.from_bytes(raw, "little") for raw in told])
        assert np.array_equal((counts - 2048) * TICK, position[0])
        imu.ask()
        agents = imu.take(None, 0.0)
        assert agents is not None
        assert (agents.roll, agents.pitch) == pytest.approx(tuple(tilt[0]), abs=1e-12)
        goal = np.rint(ticks(START * (1 - 0.01 * k)))
        fleet.command(np.tile((goal - 2048) * TICK, (2, 1)), 0.03)
        for servo, count in zip(robot.servos, goal, strict=True):
            servo.write(30, int(count).to_bytes(2, "little"))
        robot.advance(0.03)
    assert robot.pose().forward == fleet.way[0, 0]


@pytest.mark.parametrize("name", ["servo_bench", "so101", "darwin_leg"])
def test_any_robot_with_servo_ids(name: str) -> None:
    robot = VirtualRobot(RobotDescription.load(name), 3, protocol=2)
    robot.board.write(24, b"\x01")
    for servo in robot.servos:
        servo.write(64, b"\x01")
    robot.advance(0.5)
    assert np.isfinite(robot.plant.qpos).all()
    assert robot.pose().position == (0.0, 0.0, 0.0)
