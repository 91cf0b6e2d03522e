"""Files and what is in them: tables, videos, journals, near or far; read so that damaged or hostile ones do no harm."""
