-- Space packets: the primary header, cFE's headers, what cFE itself sends, and the EDORAS envelope.

local routes = D.routes
local settings = {}
local known_of = {}

-- Take what the preferences say of the headers and MsgIds; all the rest follows from it.
local function settle(extended, short, second)
	extended, settings.second = extended or second, second
	for _, link in ipairs(D.links) do known_of[link.label] = {} end
	local telemetry = extended and "telemetry_extended" or short and "telemetry_short" or "telemetry"
	settings.extra = extended and L.extended.size or 0
	settings.command = extended and L.command_extended or L.command
	settings.telemetry, settings.read_time = L[telemetry], read[telemetry]
	settings.command_header = L.ccsds.size + settings.extra + settings.command.size
	settings.telemetry_header = L.ccsds.size + settings.extra + settings.telemetry.size
end
settle(
	D.extended_header, D.telemetry_header == L.ccsds.size + L.telemetry_short.size, D.msg_id_version == 2
)
for _, form in ipairs(D.formats) do
	form.read = read[form.reader]
end
for _, route in ipairs(routes) do
	route.format = D.formats[route.format]  -- nil where the bytes shall tell
	route.kind = D.types[route.type]
end

-- The MsgId of version 1 that the names and commands of cFE have, of one of version 2.
local function known_id(msg_id)
	if not settings.second then return msg_id end
	local high, command = math.floor(msg_id / 256), math.floor(msg_id / 128) % 2
	local third, fourth = math.floor(high / 8) % 2, math.floor(high / 16) % 2
	local secondary = 1 - (fourth + command * third) % 2
	return math.floor(high / 32) * 8192 + command * 4096 + secondary * 2048
		+ high % 8 * 256 + third * 128 + msg_id % 128
end

-- What is known of a MsgId on a link: its name, the routes that may claim it, its commands.
local function look_up(link, msg_id)
	local exact, any_link, id = D.exact[link], D.any_link[msg_id], known_id(msg_id)
	local commands, name = D.commands[id], D.pdu_msg_ids[msg_id] and D.pdu_name or D.msg_id_names[id]
	local own = D.structs[msg_id]
	if own and not any_link then name = own.name or name end
	if not commands and any_link and id % 8192 >= 4096 then commands = D.route_commands end
	return {
		claims = exact and exact[msg_id] or any_link, commands = commands,
		name = name, topic = any_link and routes[any_link[1]].topic or "",
		unknown = not name and not any_link and not own, heads = {},
	}
end

local function about(link, msg_id)
	local known = known_of[link][msg_id]
	if not known then
		known = look_up(link, msg_id)
		if not known.unknown then known_of[link][msg_id] = known end  -- all others may be too many to keep
	end
	return known
end

local function name_of(known)
	return known.name or (W.route and W.route.topic) or known.topic
end

local LENGTH_BIAS, LONGEST, HIGHEST_MSG_ID = D.limits.length_bias, D.limits.software_bus, D.limits.highest_msg_id
local HEADER = L.ccsds.size

-- Follow the sequence count of a stream: one MsgId of one sender on one link.
local function follow(msg_id, count, start)
	if W.pinfo.visited then return end
	local spacecraft, key = nested(sequences, W.spacecraft), msg_id * 256 + link_by_label[W.link].code
	local endpoints = nested(nested(spacecraft, W.processor), key)
	local place, port
	if W.spacecraft > 0 or W.processor > 0 then
		place, port = receiver(endpoints)
	else
		place, port = sender(endpoints)
	end
	place[port] = place[port] or {strands = {}, place = 0}
	sequence.follow(place[port], {
		count = count, frame = W.key, body = W.s:sub(start + 1),
		boot = W.time and W.time > 0 and W.pinfo.abs_ts - W.time or nil,
	})
end

-- Judge a command's checksum and function code.
local function command(code, sent, start, length, extra)
	if checksum(W.s, start + 1, start + length) ~= 0 then
		note(sent == 0 and "checksum_absent" or "checksum_bad")
	end
	local commands = W.known.commands
	if not commands then return end
	local known = commands[code]
	if not known then
		note("unknown_function_code")
	elseif known.lengths then
		local total = #W.s - start - settings.command_header + L.ccsds.size + L.command.size
		for _, length_taken in ipairs(known.lengths) do
			if total == length_taken then return end
		end
		note("command_length")
	end
end

-- Tell the envelope's format from the bytes: its lengths hold, and an encapsulation follows.
local function detect(s, at)
	for _, form in ipairs(D.formats) do
		local start = at + form.size
		if #s >= start + 4 and not form.own then
			local length, capacity = form.read(s, at + 1)
			if length >= 4 and length <= capacity and length <= #s - start
				and s:find("^\0[\0\1]\0\0", start + 1) then
				return form
			end
		end
	end
	return nil
end

local function envelope_format(route, at)
	return route.format or detect(W.s, at) or D.formats[1]
end

-- Tell whether the bytes hold a whole message of a route.
local function suits(route, at)
	local form, s = envelope_format(route, at), W.s
	local start = at + form.size
	if #s < start + 4 then return false end
	local length = form.read(s, at + 1)
	local representation = length >= 4 and length <= #s - start - (form.crc or 0) and read.cdr(s, start + 1) or 2
	if representation > 1 or not route.kind then return false end
	local left = bytes_left(route.kind, s, start + L.cdr.size + 1, start + length, representation == 0)
	return left ~= nil and left <= route.kind.trailing
end

local function envelope(claims, at)
	local route, s = routes[claims[1]], W.s
	for index = 1, #claims > 1 and #claims or 0 do
		if suits(routes[claims[index]], at) then
			route = routes[claims[index]]
			break
		end
	end
	local form = envelope_format(route, at)
	W.route = route
	if #s - at < form.size then return truncated("edoras", at, form.size) end
	local length, capacity = form.read(s, at + 1)
	local start = at + form.size
	local crc = form.crc or 0
	local space = math.max(0, #s - start - crc)
	W.envelope, W.form = at, form
	if length > space or capacity < length then note("envelope_overrun") end
	if length > space then
		W.stop = format("cdr at byte %d needs %.0f bytes, %d are there", start, length, space)
		return
	elseif length < L.cdr.size then
		note("cdr_invalid")
		W.stop = format("cdr at byte %d needs %d bytes, %d are there", start, L.cdr.size, length)
		return
	end
	local stop = start + length
	if crc > 0 then
		local right = crc == 2 and crc16(s, at + 1, stop) or crc32(s, at + 1, stop)
		if unpack((form.little and "<I" or ">I") .. crc, s, stop + 1) ~= right then note("checksum_bad") end
	end
	if any_nonzero(s, stop + crc + 1, #s) then note("stale_tail") end
	if stop + crc < #s then W.padding = stop + crc end
	W.crc_at = crc > 0 and stop or nil
	local representation = read.cdr(s, start + 1)
	add_layer(L.cdr, start)
	W.body, W.body_end = start + L.cdr.size, stop
	if representation == 0 then note("cdr_big_endian") end
	if representation > 1 then
		note("cdr_invalid")
		W.stop = format("cdr at byte %d has representation 0x%04x; CDR is 0x0000 or 0x0001", start, representation)
		return
	end
	local kind = route.kind
	if not kind then return end
	W.big = representation == 0
	local left = bytes_left(kind, s, W.body + 1, stop, W.big)
	if left then
		W.message = kind
		if left > D.limits.rounded then note(left > kind.trailing and "cdr_too_long" or "cdr_trailing") end
		if W.listed then W.summary = short_message(kind.steps, s, W.body + 1, W.body + 1, W.big) end
	else
		note("cdr_invalid")
		W.stop = format("cdr at byte %d does not decode as %s", start, route.type)
	end
end

-- Say a command with its arguments; one that is usually zero is left out where it is.
local function said_command(layout, s, at)
	local words = {layout.title}
	for _, slot in ipairs(layout.fields) do
		local value, first, last = nil, at + slot.start + 1, at + slot.start + slot.size
		if slot.kind == "string" then
			value = utf8_text(D.text(s, first, last))
			if value == "" or value:find("%s") then value = "'" .. value .. "'" end
		else
			local number = 0
			for place = last, first, -1 do number = number * 256 + s:byte(place) end
			local half = 256 ^ slot.size / 2
			if slot.kind:sub(1, 3) == "int" and number >= half then number = number - 2 * half end
			if number ~= 0 or not slot.silent then
				local digits = math.min(2 * slot.size, 4)
				value = slot.hex and format("0x%0" .. digits .. "x", number) or slot.names and slot.names[number]
					or format("%d", number)
			end
		end
		if value then words[#words + 1] = slot.name .. "=" .. value end
	end
	return table.concat(words, " ")
end

-- Read the struct of a layout that follows the header; a packet of no bytes holds one of its function code alone.
local function own_struct(own, at, code)
	local size = #W.s - at
	local layout = L[code and own[code] or size > 0 and own[-1]]
	if not layout then return end
	if size < layout.size or size > layout.most or (size - layout.size) % (layout.step or 1) > 0 then
		if not has("command_length") then note("struct_length") end
		return
	end
	add_layer(layout, at)
	if W.listed then
		local text = short_message(steps_of(layout), W.s, at + 1, at + 1, not layout.little)
		W.summary = layout.own and layout.title .. "  " .. text or text
	end
end

-- Read what lies behind the cFE header: an event, housekeeping, or a route's envelope.
local function payload(msg_id, start, header, code)
	local at, s = start + header, W.s
	if D.pdu_msg_ids[msg_id] then
		W.pdu = at
		return
	end
	local claims = W.known.claims
	if claims then
		if #s - start > header then return envelope(claims, at) end
		W.route = routes[claims[1]]
		if has("length_mismatch") then return truncated("edoras", at, 1) end
		if code ~= 0 then note("header_only") end
	elseif D.structs[msg_id] then
		own_struct(D.structs[msg_id], at, code)
	elseif known_id(msg_id) == D.msg_id.event and #s - at >= L.event.size then
		add_layer(L.event, at)
		if not W.listed then return end
		local id, _, _, _, app, message = read.event(s, at + 1)
		W.summary = format("%s %d: %s", utf8_text(app), id, utf8_text(message))
	elseif known_id(msg_id) == D.msg_id.software_bus and #s - at >= L.software_bus.size then
		add_layer(L.software_bus, at)
		if not W.listed then return end
		local values = {read.software_bus(s, at + 1)}
		local place = L.software_bus.place
		W.summary = format(
			"pipe overflow %d, message limit %d, no subscribers %d", values[place.pipe_overflow_error_counter],
			values[place.message_limit_error_counter], values[place.no_subscribers_counter]
		)
	elseif code and D.arguments[known_id(msg_id)] then
		local layout = L[D.arguments[known_id(msg_id)][code]]
		if not layout then return end
		if #s - at < layout.size or #s - at > layout.most then
			if not has("command_length") then note("struct_length") end
			return
		end
		add_layer(layout, at)
		if W.listed then W.summary = said_command(layout, s, at) end
	end
end

-- Read a packet that starts at an offset, and all that lies behind its primary header.
local function space_packet(start)
	local work = W
	local s, length = work.s, #work.s - start
	if not take(L.ccsds, start) then return end
	local version, kind, secondary, apid, flags, count, data_length = read.ccsds(s, start + 1)
	local msg_id = version * 8192 + kind * 4096 + secondary * 2048 + apid
	if settings.second then  -- the low byte of the subsystem, where it is there
		msg_id = (s:byte(start + HEADER + 2) or 0) * 256 + kind * 128 + apid % 128
	end
	local extra = settings.extra
	local is_command, total = kind == 1, data_length + LENGTH_BIAS
	local after, link = start + HEADER, work.link
	local known = about(link, msg_id)
	work.msg_id, work.known = msg_id, known
	work.kind = work.kind or (is_command and "cmd" or "tlm")
	if total ~= length then note("length_mismatch") end
	local counted = flags > 0 or count > 0
	if not counted then note("sequence_unset") end
	if total > LONGEST then note("over_software_bus") end
	if msg_id < 1 or msg_id > HIGHEST_MSG_ID then
		note("invalid_msg_id")
	elseif known.unknown then
		note("unknown_msg_id")
	end
	local way = link_by_label[link]
	if way.to_cfs ~= way.from_cfs and is_command ~= way.to_cfs then note("wrong_direction") end

	local as_command = settings.command_header
	local bare = not is_command and length == as_command and total == length and as_command < settings.telemetry_header
	local header = (is_command or bare) and as_command or settings.telemetry_header
	work.bare = bare
	if bare then note("header_only") end
	if extra > 0 and length >= HEADER + extra then add_layer(L.extended, after) end
	if length < header then
		if counted then follow(msg_id, count, start) end
		return truncated(is_command and L.command.name or L.telemetry.name, after, header - HEADER)
	end
	local at, code, sent = after + extra, nil, nil
	if is_command or bare then
		add_layer(settings.command, at)
		local _
		_, code, sent = read.command(s, at + 1)
	else
		add_layer(settings.telemetry, at)
		local seconds, subseconds = settings.read_time(s, at + 1)
		work.time = seconds + subseconds / D.time.ticks
	end
	if counted then follow(msg_id, count, start) end
	if is_command then
		work.code = code
		command(code, sent, start, math.min(length, total), extra)
	end
	if not bare then payload(msg_id, start, header, code) end
end
