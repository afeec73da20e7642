"""Control tables: which registers a device has, and what may be written to them.

ROBOTIS e-manual: MX-28 (Protocol 1.0), MX-28 (2.0), OP2's CM-740. Defaults are the factory's except
for the rate of the bus, which is 1 Mbps on the OP2.
"""

from dataclasses import dataclass
from functools import cached_property


@dataclass(frozen=True)
class Register:
    """One entry of a control table.

    Attributes:
      name: as in the e-manual, in small letters.
      address: of its first byte.
      length: bytes, little-endian.
      initial: value from the factory.
      low: least value that can be written; None where nothing can be written.
      high: largest value.
      lasting: whether it is in the EEPROM, which keeps its value without power and cannot be
        written while torque is on.
    """

    name: str
    address: int
    length: int
    initial: int = 0
    low: int | None = None
    high: int = 0
    lasting: bool = False

    @property
    def end(self) -> int:
        """Address behind its last byte."""
        return self.address + self.length


@dataclass(frozen=True)
class ControlTable:
    """The registers of a kind of device.

    Attributes:
      protocol: that it speaks, 1 or 2.
      size: addresses that it has, from 0.
      registers: by address; addresses between them read as 0.
    """

    protocol: int
    size: int
    registers: tuple[Register, ...]

    @cached_property
    def names(self) -> dict[str, Register]:
        """Registers by name."""
        return {register.name: register for register in self.registers}


def _eeprom(*rows: tuple[str, int, int, int, int, int]) -> tuple[Register, ...]:
    return tuple(Register(*row, lasting=True) for row in rows)


def _ram(*rows: tuple[str, int, int, int, int, int]) -> tuple[Register, ...]:
    return tuple(Register(*row) for row in rows)


def _told(*rows: tuple[str, int, int], lasting: bool = False) -> tuple[Register, ...]:
    return tuple(Register(*row, lasting=lasting) for row in rows)


MX28_1 = ControlTable(
    protocol=1,
    size=74,
    registers=(
        Register("model_number", 0, 2, 29, lasting=True),
        Register("firmware", 2, 1, 36, lasting=True),
        *_eeprom(
            ("id", 3, 1, 1, 0, 252),
            ("baud_rate", 4, 1, 1, 0, 254),
            ("return_delay_time", 5, 1, 250, 0, 254),
            ("cw_angle_limit", 6, 2, 0, 0, 4095),
            ("ccw_angle_limit", 8, 2, 4095, 0, 4095),
            ("temperature_limit", 11, 1, 80, 0, 99),
            ("min_voltage", 12, 1, 60, 50, 160),
            ("max_voltage", 13, 1, 160, 50, 160),
            ("max_torque", 14, 2, 1023, 0, 1023),
            ("status_return_level", 16, 1, 2, 0, 2),
            ("alarm_led", 17, 1, 36, 0, 127),
            ("shutdown", 18, 1, 36, 0, 127),
            ("multi_turn_offset", 20, 2, 0, 0, 0xFFFF),
            ("resolution_divider", 22, 1, 1, 1, 4),
        ),
        *_ram(
            ("torque_enable", 24, 1, 0, 0, 1),
            ("led", 25, 1, 0, 0, 1),
            ("d_gain", 26, 1, 0, 0, 254),
            ("i_gain", 27, 1, 0, 0, 254),
            ("p_gain", 28, 1, 32, 0, 254),
            ("goal_position", 30, 2, 0, 0, 4095),
            ("moving_speed", 32, 2, 0, 0, 1023),
            ("torque_limit", 34, 2, 1023, 0, 1023),
        ),
        *_told(
            ("present_position", 36, 2),
            ("present_speed", 38, 2),
            ("present_load", 40, 2),
            ("present_voltage", 42, 1),
            ("present_temperature", 43, 1),
            ("registered", 44, 1),
            ("moving", 46, 1),
        ),
        *_ram(("lock", 47, 1, 0, 0, 1), ("punch", 48, 2, 0, 0, 1023)),
        *_told(("realtime_tick", 50, 2)),
        *_ram(("goal_acceleration", 73, 1, 0, 0, 254)),
    ),
)

_TURNS = 1_048_575  # ticks, the largest position of 2.0
_INDIRECT = 28

MX28_2 = ControlTable(
    protocol=2,
    size=252,
    registers=(
        Register("model_number", 0, 2, 30, lasting=True),
        Register("firmware", 6, 1, 42, lasting=True),
        *_eeprom(
            ("id", 7, 1, 1, 0, 252),
            ("baud_rate", 8, 1, 3, 0, 7),
            ("return_delay_time", 9, 1, 250, 0, 254),
            ("drive_mode", 10, 1, 0, 0, 0),
            ("operating_mode", 11, 1, 3, 3, 3),
            ("shadow_id", 12, 1, 255, 0, 255),
            ("protocol", 13, 1, 2, 2, 2),
            ("homing_offset", 20, 4, 0, -1_044_479, 1_044_479),
            ("moving_threshold", 24, 4, 10, 0, 1023),
            ("temperature_limit", 31, 1, 80, 0, 100),
            ("max_voltage", 32, 2, 160, 95, 160),
            ("min_voltage", 34, 2, 95, 95, 160),
            ("pwm_limit", 36, 2, 885, 0, 885),
            ("acceleration_limit", 40, 4, 32767, 0, 32767),
            ("velocity_limit", 44, 4, 230, 0, 1023),
            ("max_position", 48, 4, 4095, 0, 4095),
            ("min_position", 52, 4, 0, 0, 4095),
            ("shutdown", 63, 1, 52, 0, 255),
        ),
        *_ram(
            ("torque_enable", 64, 1, 0, 0, 1),
            ("led", 65, 1, 0, 0, 1),
            ("status_return_level", 68, 1, 2, 0, 2),
        ),
        *_told(("registered", 69, 1), ("hardware_error", 70, 1)),
        *_ram(
            ("velocity_i_gain", 76, 2, 1920, 0, 16383),
            ("velocity_p_gain", 78, 2, 100, 0, 16383),
            ("position_d_gain", 80, 2, 0, 0, 16383),
            ("position_i_gain", 82, 2, 0, 0, 16383),
            ("position_p_gain", 84, 2, 850, 0, 16383),
            ("feedforward_2nd", 88, 2, 0, 0, 16383),
            ("feedforward_1st", 90, 2, 0, 0, 16383),
            ("bus_watchdog", 98, 1, 0, 0, 127),
            ("goal_pwm", 100, 2, 885, -885, 885),
            ("goal_velocity", 104, 4, 0, -1023, 1023),
            ("profile_acceleration", 108, 4, 0, 0, 32767),
            ("profile_velocity", 112, 4, 0, 0, 32767),
            ("goal_position", 116, 4, 0, -_TURNS, _TURNS),
        ),
        *_told(
            ("realtime_tick", 120, 2),
            ("moving", 122, 1),
            ("moving_status", 123, 1),
            ("present_pwm", 124, 2),
            ("present_load", 126, 2),
            ("present_velocity", 128, 4),
            ("present_position", 132, 4),
            ("velocity_trajectory", 136, 4),
            ("position_trajectory", 140, 4),
            ("present_voltage", 144, 2),
            ("present_temperature", 146, 1),
        ),
        *_ram(
            *(
                (f"indirect_address_{i + 1}", 168 + 2 * i, 2, 224 + i, 64, 251)
                for i in range(_INDIRECT)
            )
        ),
        *_ram(*((f"indirect_data_{i + 1}", 224 + i, 1, 0, 0, 255) for i in range(_INDIRECT))),
    ),
)

CM740 = ControlTable(
    protocol=1,
    size=90,
    registers=(
        Register("model_number", 0, 2, 0x7400, lasting=True),
        Register("firmware", 2, 1, 20, lasting=True),
        *_eeprom(
            ("id", 3, 1, 200, 0, 252),
            ("baud_rate", 4, 1, 1, 0, 254),
            ("return_delay_time", 5, 1, 0, 0, 254),
            ("status_return_level", 16, 1, 2, 0, 2),
        ),
        *_ram(
            ("dxl_power", 24, 1, 0, 0, 1),
            ("led_panel", 25, 1, 0, 0, 7),
            ("led_head", 26, 2, 0, 0, 0x7FFF),
            ("led_eye", 28, 2, 0, 0, 0x7FFF),
        ),
        *_told(
            ("button", 30, 1),
            ("gyro_z", 38, 2),
            ("gyro_y", 40, 2),
            ("gyro_x", 42, 2),
            ("acc_x", 44, 2),
            ("acc_y", 46, 2),
            ("acc_z", 48, 2),
            ("present_voltage", 50, 1),
            ("mic_left", 51, 2),
            ("mic_right", 67, 2),
        ),
    ),
)
