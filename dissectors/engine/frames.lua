-- CCSDS transfer frames and the packets in them, by the rules of edoras_tools.io.frames.transfer, which says what is
-- meant here. What a frame needs of those before it is noted when it is read first.

local LIMITS = D.frame_limits
local channels, noted = {}, {}  -- what is known of senders, and what was noted, by W.key
local form  -- how the frame that is read is made
local check = new_field("frames", "frames.frame_error_control", "uint16", "frame_error_control", base.HEX)

-- The count by which frames of a kind follow each other, and its values.
local COUNTS = {
	tm = {"master_channel_frame_count", 0x100}, aos = {"virtual_channel_frame_count", 0x1000000},
	tc = {"frame_sequence_number", 0x100},
}

-- Return how the bytes that come to a port are framed, or nil: by the destination's, of a stream by either end's.
local function format_at(pinfo)
	local stream = pinfo.port_type == TCP
	local found = D.frames[pinfo.dst_port]
	if stream and not (found and found.stream) then found = D.frames[pinfo.src_port] end
	return found and (found.stream or false) == stream and found or nil
end

-- Return the bytes of a frame that starts so, as its header has them; nil where none does.
local function stated_length(found, s)
	local layout = L[found.layout]
	if #s < layout.size then return nil end
	local values = {read[found.layout](s, 1)}
	if values[1] ~= found.version then return nil end
	local length = found.kind == "tc" and values[layout.place.frame_length] + LIMITS.tc_bias or found.length
	return length >= found.smallest and length or nil
end

-- Tell whether so many bytes are a frame, and remember its form.
local function is_frame(pinfo, s, length)
	form = format_at(pinfo)
	return form ~= nil and stated_length(form, s) == length
end

-- Read the headers of a frame: where its data starts and ends, where its first packet starts (nil for none), whether
-- it is idle, whether it has a count, and its count, spacecraft, channel and MAP.
local function read_headers_of(s)
	local start, stop = form.start, #s - (form.fecf and LIMITS.fecf_bytes or 0)
	local behind = s:sub(start + 1, start + 2) .. "\0\0"
	local map, counted, idle, pointer, count, craft, channel = 0, true, false, 0, 0, 0, 0
	local _, second, ocf
	add_layer(L[form.layout], 0)
	if form.kind == "tm" then
		local other
		_, craft, channel, ocf, _, count, second, other, _, _, pointer = read.tm_frame(s, 1)
		if second == 1 then
			take(L.tm_secondary, start)
			start = start + 1 + select(2, read.tm_secondary(behind, 1))
		end
		idle = pointer == LIMITS.only_idle or other == 1
	elseif form.kind == "aos" then
		local high
		_, craft, channel, count, _, _, high = read.aos_frame(s, 1)
		craft, ocf = craft + high * 256, form.ocf and 1 or 0
		take(L.aos_packets, start)
		_, pointer = read.aos_packets(behind, 1)
		start = start + L.aos_packets.size
		idle = channel == LIMITS.aos_idle or pointer == LIMITS.only_idle
	else
		local bypass, control
		_, bypass, control, _, craft, channel, _, count = read.tc_frame(s, 1)
		counted, idle = bypass == 0, control == 1
		if form.segments then
			take(L.tc_segment, start)
			local flags
			flags, map = read.tc_segment(behind, 1)
			pointer = flags % 2 == LIMITS.first_part and 0 or LIMITS.no_packet
			start = start + L.tc_segment.size
		end
	end
	if ocf == 1 then stop = stop - LIMITS.ocf_bytes end
	local first = not idle and pointer ~= LIMITS.no_packet and start + pointer or nil
	return start, stop, first, idle, counted, count, craft, channel, map
end

-- Follow the count of a channel; tell whether a frame came before with the same bytes.
local function came_before(known, count, s)
	local modulus = form.modulus
	local late = modulus == 256 and LIMITS.late or modulus / 2
	local step = (count - (known.last or count) + late) % modulus - late
	if math.abs(step) > D.limits.sequence_modulus / 2 then step = D.limits.sequence_modulus / 2 end
	known.last, known.position = count, (known.position + step) % D.limits.sequence_modulus
	sequence.follow(known.counts, {count = known.position, frame = W.key, body = s})
	return known.counts.again
end

-- Note what a frame needs of those before it: the rest of a packet, whether one was cut at its start, whether the
-- frame came before.
local function look_back(s, start, stop, first, counted, count, craft, channel, map)
	local places, port = sender(channels)
	local ends = nested(nested(places, port), tostring(W.pinfo.dst) .. " " .. W.pinfo.dst_port)
	local name = format("%d %d %s", craft, channel, counted)
	local known = ends[name]
	if not known then
		known = {position = 0, run = 0, counts = {strands = {}, place = 0}, maps = {}}
		ends[name] = known
	end
	if counted then
		if came_before(known, count, s) then return {again = true} end
		if known.joined and (count - known.joined) % form.modulus > 1 then known.run = known.run + 1 end
		known.joined = count
	end
	local parts, found = nested(known.maps, map), {rest = ""}
	if start == stop and parts.run ~= known.run then return found end  -- nothing that could go on
	if parts.run == known.run then
		found.rest = parts.rest
	elseif parts.run then
		found.cut = parts.rest ~= "" or (first or stop) > start
	end
	parts.run, found.parts = known.run, parts
	return found
end

-- Find the packets in the data of a frame behind the rest of one; idle ones are left out. Return where each starts and
-- its bytes, what is left at the end, and whether a packet was cut.
local function packets_in(data, pointers)
	local found, rest, cut = {}, "", false
	for index, place in ipairs(pointers) do
		local limit = pointers[index + 1] or #data + 1
		while place < limit and byte(data, place) < 32 do  -- another version is no space packet
			local size = limit
			if limit - place >= HEADER then
				local _, _, _, apid, _, _, data_length = read.ccsds(data, place)
				size = data_length + LENGTH_BIAS
				if apid ~= LIMITS.idle_apid and place + size <= limit then found[#found + 1] = {place, size} end
			end
			if place + size > limit then
				if index == #pointers then rest = data:sub(place) else cut = true end
				break
			end
			place = place + size
		end
	end
	return found, rest, cut
end

-- Read one frame; the packets that end in it are W.packets: {where in the frame, or nil; their bytes}.
local function read_frame(s)
	local start, stop, first, idle, counted, count, craft, channel, map = read_headers_of(s)
	local fits = idle and form.kind == "tc" or start <= stop and (first or -1) < math.max(stop, start + 1)
	if not fits then note("truncated") end
	local wrong
	if form.fecf and not W.cut then
		local at = #s - LIMITS.fecf_bytes
		local right = crc16(s, 1, at)
		wrong = right ~= byte(s, at + 1) * 256 + byte(s, at + 2)
		if wrong then note("checksum_bad") end
		W.inside[W.layers] = function(node, tvb, visible)
			if not (visible or check.on) then return end
			local item = add(node, check.field, cut(tvb, at, LIMITS.fecf_bytes))
			if wrong and visible then item:append_text(format(", but the frame has 0x%04x", right)) end
		end
	end
	if W.listed then
		W.summary = format("%s frame %d of channel %d", form.kind:upper(), count, channel)
	end
	if not fits or wrong or W.cut then return nil end
	if not W.pinfo.visited then
		noted[W.key] = look_back(s, start, idle and start or stop, first, counted, count, craft, channel, map)
	end
	local known = noted[W.key]
	if not known or known.again then return nil end
	local before = #known.rest
	local data = known.rest .. s:sub(start + 1, idle and start or stop)
	local pointers = {before > 0 and 1 or nil}
	if first then pointers[#pointers + 1] = before + first - start + 1 end
	local found, rest, cut_inside = packets_in(data, pointers)
	if known.parts then known.parts.rest, known.parts = rest, nil end
	if known.cut or cut_inside then note("stream_gap") end
	for index, item in ipairs(found) do
		local at = item[1] - before - 1 + start
		found[index] = {item[1] > before and at or nil, data:sub(item[1], item[1] + item[2] - 1)}
	end
	W.packets = found
	return nil
end
HEADER_READERS.frames = read_frame
RECOGNISED.frames = function() return false end  -- a mission has to say what they are

return {
	is_frame = is_frame,
	link = function() return link_by_label[form.link] end,
	forget = function() channels, noted = {}, {} end,
	head = function(pinfo)
		local found = format_at(pinfo)
		return found and L[found.layout].size
	end,
	length = function(s, pinfo) return stated_length(format_at(pinfo), s) end,
	likely = function(s, pinfo, behind)
		local found = format_at(pinfo)
		if found.fecf then return crc16(s, 1, #s) == 0 end
		local layout, count = L[found.layout], COUNTS[found.kind]
		if #behind < layout.size then return false end
		local one, other, place = {read[found.layout](s, 1)}, {read[found.layout](behind, 1)}, layout.place
		local next_one = (other[place[count[1]]] - one[place[count[1]]]) % count[2] == 1
		local same = other[place.virtual_channel_id] == one[place.virtual_channel_id]
		return one[place.spacecraft_id] == other[place.spacecraft_id]
			and (next_one or found.kind ~= "tm" and not same)
	end,
}
