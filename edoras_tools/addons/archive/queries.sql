-- The queries of an index; the program finds each by its name.

-- name: route
CREATE OR REPLACE TEMP MACRO route(r) AS coalesce(
    r.topic,
    if(r.spacecraft > 1, 'sc_' || r.spacecraft || ' ', '') || coalesce(r.name, r.msg_id),
    'of unknown MsgId'
)

-- name: listed
SELECT capture, state, error, gone, kind, size, sha256, datagrams, start_ns, end_ns, seconds, lost,
       superseded, unaccounted, capture_drops, worst
FROM captures
WHERE (? IS NULL OR end_ns >= ?) AND (? IS NULL OR start_ns < ?)
ORDER BY start_ns NULLS LAST, capture

-- name: lost
SELECT o.capture, start_ns, o.topic, o.name, o.link, o.msg_id, o.spacecraft, o.sent, o.lost, o.unaccounted,
       causes
FROM outcomes o
JOIN captures c ON c.capture = o.capture
LEFT JOIN (
    SELECT capture, link, msg_id, topic, spacecraft, list(cause ORDER BY cause) AS causes
    FROM (SELECT DISTINCT capture, link, msg_id, topic, spacecraft, cause FROM losses)
    GROUP BY ALL
) l
  ON l.capture = o.capture AND l.link IS NOT DISTINCT FROM o.link
  AND l.msg_id IS NOT DISTINCT FROM o.msg_id AND l.topic IS NOT DISTINCT FROM o.topic
  AND l.spacecraft IS NOT DISTINCT FROM o.spacecraft
WHERE o.lost + o.unaccounted > 0
  AND (? IS NULL OR c.end_ns >= ?) AND (? IS NULL OR c.start_ns < ?)
ORDER BY c.start_ns, o.capture, o.lost DESC, o.link, o.msg_id

-- name: sent
SELECT DISTINCT capture, o.topic, o.name, o.msg_id
FROM outcomes o JOIN captures c USING (capture)
WHERE o.sent > 0 AND (? IS NULL OR c.end_ns >= ?) AND (? IS NULL OR c.start_ns < ?)

-- name: chosen
CREATE OR REPLACE TEMP VIEW chosen AS SELECT * FROM captures WHERE datagrams > 0 AND {}

-- name: totals
SELECT count(*) AS captures, sum(datagrams) AS datagrams, sum(seconds) AS seconds, min(start_ns) AS start_ns,
       max(end_ns) AS end_ns, coalesce(sum(lost), 0) AS lost, coalesce(sum(unaccounted), 0) AS unaccounted,
       count(*) FILTER (lost + unaccounted > 0) AS with_loss
FROM chosen

-- name: runs
SELECT c.capture, c.start_ns, c.datagrams, c.worst, c.lost, c.unaccounted, coalesce(sum(o.sent), 0) AS sent
FROM chosen c LEFT JOIN outcomes o USING (capture)
GROUP BY ALL ORDER BY c.start_ns, c.capture

-- name: routes
SELECT route(o) AS route, coalesce(o.link, '') AS link, count(DISTINCT o.capture) AS captures,
       count(DISTINCT o.capture) FILTER (o.lost + o.unaccounted > 0) AS with_loss,
       sum(o.sent) AS sent, sum(o.lost) AS lost, sum(o.unaccounted) AS unaccounted
FROM outcomes o JOIN chosen USING (capture)
GROUP BY 1, 2 HAVING sum(o.lost + o.unaccounted) > 0
ORDER BY sum(o.lost + o.unaccounted) DESC, route, link
LIMIT 20

-- name: shares
WITH latest AS (
    SELECT capture, start_ns FROM chosen ORDER BY start_ns DESC, capture DESC LIMIT ?
)
SELECT capture, start_ns, route(o) AS route, coalesce(o.link, '') AS link, sum(o.sent) AS sent,
       sum(o.lost + o.unaccounted) AS missing
FROM outcomes o JOIN latest USING (capture)
GROUP BY ALL HAVING sum(o.sent) > 0 ORDER BY start_ns, capture

-- name: trend
SELECT least((c.start_ns - ?) // ?, ?)::INT AS bin, sum(o.sent) AS sent,
       sum(o.lost + o.unaccounted) AS missing
FROM outcomes o JOIN chosen c USING (capture)
WHERE route(o) = ? AND coalesce(o.link, '') = ?
GROUP BY 1 ORDER BY 1

-- name: delayed
SELECT route(l) AS route, l.link, l.part, max(l.p99_ms) AS p99_ms, sum(l.count) AS timed,
       count(DISTINCT l.capture) AS captures
FROM latencies l JOIN chosen USING (capture)
GROUP BY 1, 2, 3 HAVING max(l.p99_ms) > 0
ORDER BY captures > 1 DESC, p99_ms DESC, route, link, part
LIMIT 6

-- name: delays
SELECT c.start_ns, max(l.p99_ms) AS p99_ms
FROM latencies l JOIN chosen c USING (capture)
WHERE route(l) = ? AND l.link = ? AND l.part = ?
GROUP BY ALL ORDER BY 1

-- name: rules
SELECT severity, rule, count(DISTINCT capture) AS captures, count(*) AS verdicts, sum(v.lost) AS lost,
       arg_max(reason, coalesce(v.lost, 0)) AS example
FROM verdicts v JOIN chosen USING (capture)
WHERE severity IN ('error', 'warning')
GROUP BY 1, 2 ORDER BY severity, captures DESC, rule
