"""Trials that an operator wants ended are remembered until they are."""

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"


def upgrade() -> None:
    """Add the column; no trial of before is to be ended."""
    column = sa.Column("cancelled", sa.Boolean, nullable=False, server_default=sa.false())
    op.add_column("trials", column)


def downgrade() -> None:
    """Drop it."""
    op.drop_column("trials", "cancelled")
