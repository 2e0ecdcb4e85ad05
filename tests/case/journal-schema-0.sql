-- A journal of schema 0, which had neither hashes nor chain; as text, so that a person can read what is migrated.
PRAGMA application_id = 1365724270;
PRAGMA user_version = 0;
BEGIN;
CREATE TABLE about (number TEXT NOT NULL);
CREATE TABLE entries (number INTEGER PRIMARY KEY, kind TEXT NOT NULL, at TEXT NOT NULL, by TEXT NOT NULL,
    versions TEXT NOT NULL, settings TEXT NOT NULL, rests_on TEXT NOT NULL, content TEXT NOT NULL);
INSERT INTO about VALUES ('C-7F3K-9QTM-2XWD');
INSERT INTO entries VALUES (1, 'acquired', '2026-01-31T08:15:30.000125+00:00', 'receiver', '{"sightline":"0.0.9"}',
    '{"frame_index":null}', '[]',
    '{"original":"2b4c342f5433ebe591a1da77e013d1b72475562d48578dca8b84bac6651c3cb9.png","white":4095.0}');
INSERT INTO entries VALUES (2, 'calibrated', '2026-01-31T08:15:29.500000+00:00', 'app', '{"sightline":"0.0.9"}',
    '{"frame":"gamma","method":"smooth"}', '[1]', '{"focal_point_mm":[15.1,-10.25,-620.0000000000001],"view":"pa"}');
INSERT INTO entries VALUES (3, 'changed', '2026-01-31T08:16:01.000000+00:00', 'surgeon', '{"sightline":"0.0.9"}', '{}',
    '[]', '{"what":"Seite über Γ geändert"}');
COMMIT;
