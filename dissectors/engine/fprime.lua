-- The ground link of F Prime: frames, the packets in them, and with a dictionary the values in those, as
-- edoras_tools.addons.fprime reads them. Offsets count from the datagram's first byte, from 0.

local PRIME = D.of_links.fprime
local BOOK = D.dictionary or {described = {}, entries = {}, structs = {}, enums = {}}
local OWN, SPACE, TC_SHAPE, TM_SHAPE = 1, 2, 3, 4
local SHAPES = {  -- the header in front, and the bytes of the check at the end
	{L.fprime, "crc32", 4}, {L.fprime_space_packet, nil, 0}, {L.fprime_tc, "frame_error_control", 2},
	{L.fprime_tm, "frame_error_control", 2},
}
local CHECKS = {
	crc32 = new_field("fprime", "fprime.crc32", "uint32", "crc32", base.HEX),
	frame_error_control = new_field("fprime", "fprime.frame_error_control", "uint16", "frame_error_control", base.HEX),
}
local ENTRIES = {}
for kind, name in pairs(PRIME.entry_headers) do ENTRIES[kind] = L[name] end
local BLANK = ("\0"):rep(16)

-- Tell which shapes so many bytes may have: own, space packet, TC frame, TM frame. Not all of them may be there.
local function shapes(s, length)
	local have, head = #s, s:sub(1, 8) .. BLANK
	local own = have >= 4 and read.fprime(head, 1) == PRIME.start_word
	local version, _, secondary, apid, _, _, data_length = read.fprime_space_packet(head, 1)
	local space = have >= 8 and version == 0 and secondary == 0 and apid == read.fprime_packet(head, 7)
		and data_length + LENGTH_BIAS == length
	local control, frame_length
	version, _, control, _, _, _, frame_length = read.fprime_tc(head, 1)
	local tc = have >= 4 and version == 0 and control == 0 and frame_length + D.frame_limits.tc_bias == length
		and length >= L.fprime_tc.size + 2
	local _, second, other, order, segments, first
	version, _, _, _, _, _, second, other, order, segments, first = read.fprime_tm(head, 1)
	local tm = have >= 5 and version == 0 and second == 0 and other == 0 and order == 0 and segments == 3
		and length >= L.fprime_tm.size + 2 and (have < 6 or first < length or first >= D.frame_limits.only_idle)
	return own, space, tc, tm
end

RECOGNISED.fprime = function(s, length)
	local own, space, tc, tm = shapes(s, length)
	return own or space or tc or tm
end

-- Return the bytes of the frame, or of what keeps the stream alive, that starts so; nil where none does.
local function length_in_stream(s, pinfo)
	if s == PRIME.keep_alive then return #s end
	local framed = D.frames[pinfo.dst_port] or D.frames[pinfo.src_port]
	local tm_bytes = framed and framed.length or PRIME.tm_bytes
	local stated = select(7, read.fprime_tc(s, 1)) + D.frame_limits.tc_bias
	local inside = select(7, read.fprime_space_packet(s, 1 + L.fprime_tc.size)) + LENGTH_BIAS
	local is_tc = inside + L.fprime_tc.size + 2 == stated
	local own, _, tc, tm = shapes(s, is_tc and stated or tm_bytes)
	if own then return select(2, read.fprime(s, 1)) + L.fprime.size + 4 end
	return tc and is_tc and stated or tm and tm_bytes or nil
end

-- Values of a dictionary: each entry gets a field for each of its values, named as its topic.

local function add_records(records, members, prefix)
	for _, member in ipairs(members) do
		local name = prefix .. "." .. member.name
		local struct, kind = BOOK.structs[member.kind], member.kind
		if struct then
			add_records(records, struct, name)
		elseif kind == "string" or kind == "bool" or kind == "float" or kind == "double" then
			records[name] = new_field("fprime", name, kind, member.name)
		else
			records[name] = new_field(
				"fprime", name, kind, member.name, base.DEC, member.enum and BOOK.enums[member.enum]
			)
		end
	end
end

for _, entries in pairs(BOOK.entries) do
	for _, entry in pairs(entries) do
		entry.prefix, entry.records = entry.topic:sub(2):gsub("/", "."), {}
		add_records(entry.records, entry.members, entry.prefix)
	end
end

local CODES = {
	bool = ">B", uint8 = ">B", int8 = ">b", uint16 = ">I2", int16 = ">i2", uint32 = ">I4", int32 = ">i4",
	uint64 = ">E", int64 = ">e", float = ">f", double = ">d",
}
local taking  -- of the entry that is read: itself, its items, and where it must end
local take_member

-- Take one value at a place; return the place behind it, its word and the value; nil where it does not fit.
local function take_one(member, p, path, name)
	local s, last = W.s, taking.last
	local struct = BOOK.structs[member.kind]
	if struct then
		local told = {}
		for index, part in ipairs(struct) do
			local word
			p, word = take_member(part, p, path .. "." .. part.name, name .. "." .. part.name)
			if not p then return nil end
			told[index] = part.name .. "=" .. word
		end
		return p, "{" .. table.concat(told, ", ") .. "}"
	end
	local item = {path = path, record = taking.entry.records[name], at = p - 1}
	local word
	taking.items[#taking.items + 1] = item
	if member.kind == "string" then
		if p + 1 > last then return nil end
		local size = unpack(">I2", s, p)
		local room = taking.entry.padded and member.most or size
		if size > member.most or p + 1 + room > last then return nil end
		local text = D.text(s, p + 2, p + 1 + size)
		if utf8_text(text) ~= text then text = text:gsub("[\128-\255]", "?") end
		item.size, item.value = size + 2, text
		return p + 2 + room, item.value
	end
	if p + member.size - 1 > last then return nil end
	item.size, item.value = member.size, (unpack(CODES[member.kind], s, p))
	local value, names = item.value, member.enum and BOOK.enums[member.enum]
	if member.kind == "bool" then
		word = value ~= 0 and "True" or "False"
	elseif member.kind == "float" or member.kind == "double" then
		word = value ~= value and "nan" or format("%.9g", value)
	else
		word = names and names[tonumber(tostring(value))] or member.size < 8 and format("%d", value) or tostring(value)
	end
	return p + member.size, word, value
end

-- The same for one member, which may be an array.
function take_member(member, p, path, name)
	if not member.count then return take_one(member, p, path, name) end
	local told = {}
	for index = 1, member.count do
		p, told[index] = take_one(member, p, format("%s[%d]", path, index - 1), name)
		if not p then return nil end
	end
	return p, "[" .. table.concat(told, ", ") .. "]"
end

-- Say a number in a form of FPP, which is one of C; nil where it is not for it.
local function formed(spec, value, kind)
	local letter = spec:sub(-1)
	if letter:find("[CDO]") then letter = letter:lower() end
	local is_float = kind == "float" or kind == "double"
	if kind == "bool" then value = value ~= 0 and 1 or 0 end
	if letter:find("[efgEFG]") then
		if type(value) ~= "number" then value = tonumber(tostring(value)) end
	elseif is_float then
		if letter:find("%a") then return nil end
		spec, letter = spec .. "g", "g"
	elseif not letter:find("%a") then
		spec, letter = spec .. "d", "d"
	end
	if type(value) ~= "number" then  -- 64 bits
		local text = tostring(value)
		if letter:lower() == "x" then text = value:tohex():gsub("^0+(.)", "%1") end
		if letter == "X" then text = text:upper() end
		return (" "):rep((tonumber(spec:match("^%d+")) or 0) - #text) .. text
	elseif letter == "c" then
		return utf8_character(value)
	elseif value < 0 and letter:find("[xXo]") then
		return "-" .. format("%" .. letter, -value)
	end
	local done, text = pcall(format, "%" .. spec:sub(1, -2) .. letter, value)
	return done and text or nil
end

-- The text of an event with its arguments: {} says the next of them, and a brace that is meant is written twice.
local function event_text(entry, values, told)
	if not entry.format then return table.concat(told, " ") end
	local place = 0
	return (entry.format:gsub("([{}])([^{}]*)([{}])", function(open, spec, close)
		if open == close and spec == "" then return open end
		if open .. close ~= "{}" or not spec:find("^%d*%.?%d*[cdxoefgCDXOEFG]?$") then return nil end
		place = place + 1
		local value, kind = values[place], place <= #entry.members and entry.members[place].kind
		return spec ~= "" and value and CODES[kind] and formed(spec, value, kind) or told[place]
	end))
end

-- Read the values of an entry that start behind its ID; return where they end, or nil where they do not fit.
local function take_entry(entry, at, stop)
	taking = {entry = entry, items = {}, last = stop}
	local p = at + 1 + (entry.timed and PRIME.time_bytes or 0)
	local told, pairs_told, values = {}, {}, {}
	for index, member in ipairs(entry.members) do
		p, told[index], values[index] = take_member(member, p, member.name, entry.prefix .. "." .. member.name)
		if not p then return nil end
		pairs_told[index] = member.name .. "=" .. told[index]
	end
	if p - 1 > stop then return nil end
	local text = table.concat(entry.word == "channel" and told or pairs_told, " ")
	if entry.severity then text = (entry.severity .. " " .. event_text(entry, values, told)):gsub("%s+$", "") end
	return p - 1, entry.name .. (text ~= "" and ": " or "") .. text, taking.items
end

-- Show what was read, below the header that has its ID.
local function values_shower(text, items)
	return function(node, tvb, visible)
		if visible then node:append_text(": " .. printable(text)) end
		for _, item in ipairs(items) do
			if visible or item.record.on then
				local range = cut(tvb, item.at, item.size)
				local made
				if type(item.value) == "string" then
					made = add(node, item.record.field, range, item.value)
				else
					made = add(node, item.record.field, range)
				end
				if visible and item.path:find("[.%[]") then
					made.text = item.path .. made.text:gsub("^[^:]*", "", 1)
				end
			end
		end
	end
end

-- Read a header and what is told of it without a dictionary.
local function tell_header(layout, at)
	if not W.listed then return end
	local slot = layout.fields[1]
	local number = read[layout.name](W.s, at + 1)
	local name = slot.names and slot.names[number]
	local text = format(slot.hex and "0x%0" .. 2 * slot.size .. "x" or "%d", number)
	local title = layout == L.fprime_packet and "" or layout.title:gsub("^F Prime ", ""):lower() .. " "
	table.insert(W.told, title .. (name and format("%s (%s)", name, text) or text))
end

-- Read what a packet holds behind its type, by the dictionary.
local function entries_of(kind, at, stop)
	local layout, known = ENTRIES[kind], BOOK.entries[kind] or {}
	local width = layout.fields[1].size
	while true do
		if at + width > stop then return note("length_mismatch") end
		local entry = known[(unpack(">I" .. width, W.s, at + 1))]
		local behind, text, items
		if entry then behind, text, items = take_entry(entry, at + width, stop) end
		if at + layout.size <= stop then
			add_layer(layout, at, items and values_shower(text, items))
			if not items then tell_header(layout, at) end
		end
		if not entry then return note("unknown_msg_id") end
		if not behind then return note("struct_length") end
		table.insert(W.entries_read, entry)
		if W.listed then table.insert(W.told, text) end
		if behind >= stop then return end
		if entry.word ~= "channel" and entry.word ~= "event" then return note("length_mismatch") end
		at = behind
	end
end

-- Read one packet from a place to another; `space` is where the space packet around it starts. Tell whether it is whole.
local function packet(space, at, stop, fits)
	if space and space <= at - L.fprime_space_packet.size then add_layer(L.fprime_space_packet, space) end
	if stop - at < L.fprime_packet.size then return false end
	add_layer(L.fprime_packet, at)
	local kind = read.fprime_packet(W.s, at + 1)
	local behind, layout = at + L.fprime_packet.size, ENTRIES[kind]
	local whole = stop - behind >= (layout and layout.size or 0)
	if not (whole and fits and layout) then
		tell_header(L.fprime_packet, at)
	elseif BOOK.described[kind] then
		entries_of(kind, behind, stop)
	else
		add_layer(layout, behind)
		tell_header(layout, behind)
	end
	return whole and fits
end

-- Read the packets between two places of a CCSDS frame; idle ones are left out. Tell whether all are whole.
local function space_packets(at, stop)
	local all = true
	while at < stop do
		local inside, behind, idle = math.min(at + HEADER, stop), stop + 1, false
		if stop - at >= HEADER then
			local _, _, _, apid, _, _, data_length = read.ccsds(W.s, at + 1)
			behind, idle = at + data_length + LENGTH_BIAS, apid == D.frame_limits.idle_apid
		end
		if not idle then all = packet(at, inside, math.min(behind, stop), behind <= stop) and all end
		at = behind
	end
	return all
end

-- Read one frame and the packets in it.
local function read_ground_frame(s)
	W.told, W.entries_read = {}, {}
	local own, space, tc = shapes(s, #s)
	local shape = own and OWN or space and SPACE or tc and TC_SHAPE or TM_SHAPE
	local header, name, check_bytes = SHAPES[shape][1], SHAPES[shape][2], SHAPES[shape][3]
	if name and not take(header, 0) then return nil end
	local size = own and select(2, read.fprime(s, 1)) + header.size + check_bytes or #s
	if #s < header.size + check_bytes or size > #s then return truncated(header.name, 0, size) end
	local check = size - check_bytes
	if name then
		local right = own and crc32(s, 1, check) or crc16(s, 1, check)
		local wrong = right ~= unpack(">I" .. check_bytes, s, check + 1)
		if wrong then note("checksum_bad") end
		local record = CHECKS[name]
		W.inside[W.layers] = function(node, tvb, visible)
			if not (visible or record.on) then return end
			local item = add(node, record.field, cut(tvb, check, check_bytes))
			if wrong and visible then item:append_text(", which is wrong") end
		end
	end
	local whole
	if own then
		whole = packet(nil, header.size, check, true)
	else
		local first, ocf = 0, 0
		if shape == TM_SHAPE then
			local _
			_, _, _, ocf, _, _, _, _, _, _, first = read.fprime_tm(s, 1)
		end
		whole = space_packets((name and header.size or 0) + first, check - ocf * D.frame_limits.ocf_bytes)
	end
	if not whole then
		note("truncated")
	elseif size < #s then
		note("length_mismatch")
	end
	if W.listed then W.summary = #W.told > 0 and table.concat(W.told, "; ") or "no packet" end
	return nil
end
HEADER_READERS.fprime = read_ground_frame

return {
	length = length_in_stream, head = function() return #PRIME.keep_alive end,
	likely = function(s)
		if s == PRIME.keep_alive then return true end
		local own, _, tc, tm = shapes(s, #s)
		if own then return crc32(s, 1, #s - 4) == unpack(">I4", s, #s - 3) end
		return (tc or tm) and crc16(s, 1, #s) == 0
	end,
}
