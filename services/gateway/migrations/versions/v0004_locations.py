"""Answers to repeated requests tell again where what was made is found."""

import sqlalchemy as sa
from alembic import op

revision = "0004"
down_revision = "0003"


def upgrade() -> None:
    """Add the column; answers of before have none."""
    op.add_column("answers", sa.Column("location", sa.String(256), nullable=True))


def downgrade() -> None:
    """Drop it."""
    op.drop_column("answers", "location")
