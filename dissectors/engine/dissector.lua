-- The dissector itself: read a datagram, fill the columns, and add to the tree what is asked for.

local edoras = P.edoras
for _, link in ipairs(D.links) do
	local what = "Further ports of the link " .. link.doc
	if link.label ~= "frames" then  -- what these are like is for a mission to say
		edoras.prefs[link.label .. "_ports"] = Pref.range(link.name .. " ports", "", what, 65535)
	end
end
edoras.prefs.extended_header = Pref.bool(
	"Extended header", D.extended_header, "Packets carry cFE's extended header"
)
edoras.prefs.short_telemetry_header = Pref.bool(
	"12-byte telemetry header", D.telemetry_header == 12, "Older cFE builds: no spare in the telemetry header"
)
edoras.prefs.msg_ids_of_version_2 = Pref.bool(
	"MsgIds of version 2", D.msg_id_version == 2, "cFE builds MsgIds with the extended header's subsystem"
)

-- Return the ports of a link, those of its preference among them.
local function ports_of(label, list)
	local found = label == "frames" and {} or port_set(edoras.prefs[label .. "_ports"])
	for _, port in ipairs(list) do found[port] = true end
	return found
end

local registered, streams = {}, {}
local STREAMS = {sbn = "tcp.port", fprime = "tcp.port", racs2 = "ws.port"}  -- where Wireshark looks for who reads what a stream holds

-- Let the links read what comes over TCP: the messages themselves, or what WebSocket frames hold.
local function register_streams()
	for _, entry in ipairs(streams) do DissectorTable.get(entry[1]):remove(entry[2], entry[3]) end
	streams = {}
	for label, list in pairs(D.stream_ports) do
		stream_ports[label] = ports_of(label, list)
		for port in pairs(STREAMS[label] and stream_ports[label] or {}) do
			streams[#streams + 1] = {STREAMS[label], port, P[label]}
			DissectorTable.get(STREAMS[label]):add(port, P[label])
		end
	end
	for port, form in pairs(D.frames) do
		if form.stream and not form.own then
			streams[#streams + 1] = {"tcp.port", port, P.frames}
			DissectorTable.get("tcp.port"):add(port, P.frames)
		end
	end
end

local function register_ports()
	local udp = DissectorTable.get("udp.port")
	for port in pairs(registered) do udp:remove(port, edoras) end
	registered = {}
	for label in pairs(ports) do
		ports[label] = ports_of(label, D.ports[label])
		for port in pairs(ports[label]) do registered[port] = true end
	end
	for port, name in pairs(D.left) do
		local other = not registered[port] and Dissector.get(name)
		if other then udp:add(port, other) end
	end
	for port, form in pairs(D.frames) do
		if not form.stream then registered[port] = true end
	end
	for port in pairs(registered) do udp:add(port, edoras) end
	register_streams()
	settle(edoras.prefs.extended_header, edoras.prefs.short_telemetry_header, edoras.prefs.msg_ids_of_version_2)
end

function edoras.prefs_changed()
	register_ports()
end

local begun = {}  -- by the two ends of a stream: that messages were found in it
local skipped = {}  -- by frame and bytes that are at hand: those before the first message, or true where more are needed

function edoras.init()
	peers, sequences, analysis = {}, {}, {}
	frames.forget()
	begun, skipped = {}, {}
	asked.last, passes[true].last, passes[false].last = math.huge, math.huge, math.huge
end

-- Forget what a datagram that the capture cut cannot be blamed for.
local function forgive()
	note("capture_cut")
	local kept = 0
	for index = 1, W.findings do
		local finding = W.found[index]
		if not FINDINGS[finding].unknowable then
			kept = kept + 1
			W.found[kept] = finding
		end
	end
	W.findings = kept
end

-- What people would say of a packet of which nothing more is known.
local function said_of(known)
	if not known then return W.stop or format("%d bytes", #W.s) end
	if W.code then
		local command = D.commands[known_id(W.msg_id)] and known.commands[W.code]
		return format("function code %d", W.code) .. (command and " " .. command.name or "")
	end
	return W.bare and "header only" or known.name or ""
end

-- The findings that are more than a note, the gravest first.
local function badges()
	local text = ""
	for rank = 3, 2, -1 do
		for index = 1, W.findings do
			local finding = FINDINGS[W.found[index]]
			if finding.rank == rank then text = text .. finding.badge .. "  " end
		end
	end
	return text
end

-- What the list says of a packet, and the part of it that is its message: what is wrong, and its values.
local function info()
	local known, head = W.known, W.kind
	local text = W.summary and printable(W.summary) or said_of(known)
	if known then
		local name = W.message and W.route.topic or name_of(known)
		if text == name then text = "" end
		head = known.heads[name]
		if not head then
			head = format(name == "" and "%s 0x%04x" or "%s 0x%04x %s", W.kind, W.msg_id, name)
			known.heads[name] = head
		end
	end
	if W.findings > 0 then text = badges() .. text end
	local missing = analysis[W.key]
	if missing then
		missing = type(missing) == "number" and format("[gap of %d]", missing) or "[" .. missing .. "]"
		text = text == "" and missing or text .. "  " .. missing
	end
	if not head then return text, text end
	return text == "" and head or head .. "  " .. text, text
end

local function show_word(node, record, tvb, at, size)
	local little = W.form.little
	local range = cut(tvb, at, size)
	if size == 8 then
		(little and add_le or add)(node, record.field, range)
	elseif record == F.crc then
		(little and add_le or add)(node, record.field, range)
	else  -- Wireshark would take 8 bytes
		add(node, record.field, range, little and range:le_uint64() or range:uint64())
	end
end

-- Add our own layer: the envelope, or a place for what we say of a packet without one.
local function show_own(tree, tvb, visible)
	local at = W.envelope
	local node
	if not visible then
		node = add(tree, edoras)
	elseif at then
		node = add(tree, edoras, cut(tvb, at, W.form.size), "EDORAS Envelope")
	else
		node = add(tree, edoras)
		set_generated(node)
	end
	for _, word in ipairs(at and W.form.words or {}) do
		local record = F[word.name]
		if visible or record.on then show_word(node, record, tvb, at + word.at, word.size) end
	end
	if W.crc_at and (visible or F.crc.on) then show_word(node, F.crc, tvb, W.crc_at, W.form.crc) end
	return node
end

local function show_message(tree, tvb, visible)
	local at, size, kind = W.body, W.body_end - W.body, W.message
	local record = kind and kind.record or F.body
	local node = tree
	if size > 0 and (visible or record.on) then node = add(tree, record.field, cut(tvb, at, size)) end
	if kind and (visible or kind.on) then show_steps(node, kind.steps, tvb, W.s, at + 1, at + 1, W.big, visible) end
end

local function show_findings(node, visible)
	for index = 1, W.findings do
		local finding = FINDINGS[W.found[index]]
		add_expert(show_value(node, F.finding, finding.label, visible), finding.expert)
	end
	local missing = analysis[W.key]
	if missing then
		local kind = type(missing) == "number" and "gap" or missing
		add_expert(show_value(node, F[kind], kind == "gap" and missing or true, visible), EXPERT[kind])
	end
end

local function show_facts(node, visible)
	show_value(node, F.link, W.link, visible)
	local known = W.known
	if known then
		show_value(node, F.msg_id, W.msg_id, visible)
		local name = name_of(known)
		if name ~= "" then show_value(node, F.name, name, visible) end
		local command = W.code and known.commands and known.commands[W.code]
		if command then show_value(node, F.command, command.name, visible) end
	end
	local route = W.route
	if route then
		show_value(node, F.topic, route.topic, visible)
		show_value(node, F.type, route.type, visible)
	end
	for _, entry in ipairs(W.entries_read or {}) do
		show_value(node, F.topic, entry.topic, visible)
		show_value(node, F.type, entry.type, visible)
	end
	if W.time then
		show_value(node, F.mission_time, W.time, visible)
		if D.time.epoch then show_value(node, F.mission_utc, os.date("!%FT%TZ", D.time.epoch + W.time), visible) end
	end
	if W.stop then show_value(node, F.stop, W.stop, visible) end
	if W.text and W.text ~= "" then show_value(node, F.text, W.text, visible) end
end

local CDR, SUBSCRIPTIONS, CFDP = L.cdr, L.sbn_sub, Dissector.get("cfdp")

-- Add every layer, outermost first; return where findings belong.
local function show(tree, tvb, visible)
	local ours, node = visible or asked.protocols.edoras, nil
	local layers, places = W.layer, W.at
	for index = 1, W.layers do
		local layout, at = layers[index], places[index]
		if layout == CDR and ours then node = show_own(tree, tvb, visible) end
		if visible or layout.on then
			local header = show_layout(tree, layout, tvb, at, visible)
			if layout == CDR then
				show_message(header, tvb, visible)
			elseif layout == SUBSCRIPTIONS then
				for entry = 0, W.entries - 1 do
					show_layout(header, L.subscription, tvb, at + layout.size + entry * L.subscription.size, visible)
				end
			elseif W.inside[index] then
				W.inside[index](header, tvb, visible)
			end
		end
	end
	if not ours then return tree end
	node = node or show_own(tree, tvb, visible)
	if W.padding and (visible or F.padding.on) then
		add(node, F.padding.field, cut(tvb, W.padding, #W.s - W.padding))
	end
	show_facts(node, visible)
	return node
end

local reported_len, captured_len, raw = Tvb.reported_len, Tvb.captured_len, Tvb.raw

-- What tells the messages of one frame apart: a packet out of a transfer frame may begin where that does.
local function key_of(number, tvb, inner)
	return number + (2 * tvb:offset() + (inner and 1 or 0)) / 0x400000
end

-- Read what is of a link, and show it; return what the packet list says of it.
local function dissect_as(link, s, tvb, pinfo, tree, wanted, inner)
	local visible, number, cut_off = wanted == "all", pinfo.number, reported_len(tvb) > #s
	local listed = has_columns(pinfo, visible, number) or visible or F.text.on
	begin(s, link.label, pinfo, key_of(number, tvb, inner), listed, cut_off)
	local room = link.receive_buffer
	-- cFS takes what the header says: what is cut behind that is no loss.
	if room and #s > room and not (link.to_cfs and select(7, read.ccsds(s, 1)) + D.limits.length_bias <= room) then
		note(link.over_receive_buffer)
	end
	local start = (HEADER_READERS[link.label] or read_headers)(s, link)
	if start then space_packet(start) end
	if cut_off then forgive() end
	local line
	if listed then line, W.text = info() end
	show_findings(wanted and show(tree, tvb, visible) or tree, visible)
	if W.pdu and W.pdu < #s then CFDP:call(cut(tvb, W.pdu):tvb(), pinfo, tree) end  -- it fills columns, too
	return line
end

local told = {}  -- what the list says of the last frame that had messages
local MOST_SHOWN = 4096  -- characters of a column

local function dissect(tvb, pinfo, tree)
	if pinfo.in_error_pkt then return 0 end  -- what an ICMP error quotes was not sent again
	local s = captured_len(tvb) > 0 and raw(tvb) or ""
	local framed = frames.is_frame(pinfo, s, reported_len(tvb))
	local link = framed and link_by_label.frames or link_of(pinfo, s, reported_len(tvb))
	if not link then return 0 end
	local wanted = look_who_asks(tree, pinfo.number)
	local line = dissect_as(link, s, tvb, pinfo, tree, wanted)
	local key = W.key
	local inner = framed and frames.link()
	for _, packet in ipairs(W.packets or {}) do
		local at, bytes = packet[1], packet[2]
		if inner.port_decides or likeness(inner, pinfo, bytes, #bytes) > 0 then
			local own = at and cut(tvb, at, #bytes):tvb() or ByteArray.new(bytes, true):tvb("Packet over frames")
			local more = dissect_as(inner, bytes, own, pinfo, tree, wanted, true)
			line = line and line .. "; " .. more
		end
	end
	if line then
		if told.number == pinfo.number and told.key < key then  -- a further message of one segment
			line = #told.line > MOST_SHOWN and told.line or told.line .. "; " .. line
		end
		told.number, told.key, told.line = pinfo.number, key, line
		local columns = pinfo.cols
		columns.protocol = link.name
		columns.info = line
	end
	return #s
end

-- Tell whether a whole message looks like one of SBN: a known type, and a size that agrees with what it holds.
local function likely_sbn(s)
	local size, kind = read.sbn(s, 1)
	local first, expected = L.sbn.size + 1, D.sbn.names[kind] and 0
	if kind == D.sbn.APP then
		expected = #s >= L.sbn.size + L.ccsds.size and select(7, read.ccsds(s, first)) + D.limits.length_bias
	elseif kind == D.sbn.PROTO then
		expected = L.sbn_proto.size
	elseif kind == D.sbn.SUB or kind == D.sbn.UNSUB then
		expected = #s >= L.sbn.size + L.sbn_sub.size and L.sbn_sub.size + read.sbn_sub(s, first) * L.subscription.size
	end
	return kind ~= D.sbn.NO_MSG and size == expected  -- zeros, of which payloads are full, would be messages
end

-- How messages that follow each other in a stream are told apart: bytes that tell the length of any, the length of the
-- one that starts at a place (nil where none does, and what is left is taken for one), and whether one is likely.
local FRAMINGS = {
	sbn = {
		head = function() return L.sbn.size end,
		length = function(s)
			local size = read.sbn(s, 1)
			return size >= 0 and L.sbn.size + size or nil
		end,
		likely = likely_sbn,
	},
	frames = frames, fprime = fprime,
}

-- Its low bits: the SYN of either end was seen. Older versions do not have it.
local known, from_start = pcall(function() return Field.new("tcp.completeness") end)
from_start = known and from_start
local LONGEST_SEARCH = 0x10000  -- bytes in which a message has to begin
-- Return how many bytes of what is at hand are before the first message that is whole and likely, and that another one
-- or the end follows; nil where there is none.
local function first_message(framing, s, pinfo)
	local head = framing.head(pinfo)
	local function whole(at)
		local length = #s - at + 1 >= head and framing.length(s:sub(at, at + head - 1), pinfo)
		return length and length > 0 and at + length - 1 <= #s and length
	end
	for at = 1, #s - head + 1 do
		local length = whole(at)
		local behind = length and s:sub(at + length, at + length + head - 1)
		if length and (#behind < head or framing.length(behind, pinfo))
			and framing.likely(s:sub(at, at + length - 1), pinfo, behind) then
			return at - 1
		end
	end
end

-- Return how many bytes are before the first message, where the capture begins inside a stream; true for more bytes.
local function skip(framing, tvb, pinfo)
	local s = raw(tvb)
	local key = pinfo.number .. ":" .. #s
	if pinfo.visited then return skipped[key] or 0 end
	local ends = format("%s %d %s %d", pinfo.src, pinfo.src_port, pinfo.dst, pinfo.dst_port)
	local seen = from_start and from_start()
	if begun[ends] or seen and seen.value % 4 > 0 then return 0 end
	local before = first_message(framing, s, pinfo)
	begun[ends] = before ~= nil
	skipped[key] = before or (pinfo.can_desegment == 0 or #s > LONGEST_SEARCH) and #s or true
	return skipped[key]
end

-- Wireshark puts the stream in order.
local function dissect_stream(framing)
	local function message_length(tvb, pinfo, offset)
		return framing.length(raw(tvb, offset, framing.head(pinfo)), pinfo) or tvb:reported_length_remaining(offset)
	end
	return function(tvb, pinfo, tree)
		local head = framing.head(pinfo)
		if not head then return 0 end
		local before = framing.likely and skip(framing, tvb, pinfo) or 0
		if before == true then
			pinfo.desegment_offset, pinfo.desegment_len = 0, DESEGMENT_ONE_MORE_SEGMENT
			return captured_len(tvb)
		elseif before == captured_len(tvb) then
			return before
		end
		dissect_tcp_pdus(before > 0 and tvb(before):tvb() or tvb, tree, head, message_length, dissect)
		if before > 0 and pinfo.desegment_len > 0 then pinfo.desegment_offset = pinfo.desegment_offset + before end
		return captured_len(tvb)
	end
end

for name, protocol in pairs(P) do
	protocol.fields = members[name]
	protocol.dissector = FRAMINGS[name] and dissect_stream(FRAMINGS[name]) or dissect
end
edoras.experts = experts
register_ports()
if P.racs2 then DissectorTable.get("ws.protocol"):add(D.of_links.racs2.subprotocol, P.racs2) end
DissectorTable.get("udp.port"):add_for_decode_as(edoras)
