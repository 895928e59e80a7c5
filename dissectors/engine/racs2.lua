-- RACS2 messages: the header, and the values of the body, where it is a RACS2Bridge_std_msgs (Protocol Buffers), as the
-- public examples have.

local body_length = new_field("racs2", "racs2.body_length", "uint32", "body_length", base.DEC)
local VALUES = {}  -- by field number
for number, item in pairs(D.of_links.racs2.values) do
	local format_of = ({int64 = base.DEC, uint64 = base.DEC})[item.kind]
	VALUES[number] = {
		kind = item.kind, name = item.name, array = item.array, width = ({float = 4, double = 8})[item.kind],
		record = new_field("racs2", "racs2.body." .. item.name, item.kind, item.name, format_of),
	}
end

-- Read a varint at a place (from 1) of a string: its low and high 32 bits, and the place behind it; nil where it is cut.
local function varint(s, p, last)
	local low, high, shift = 0, 0, 0
	while p <= last and shift < 70 do
		local octet = byte(s, p)
		local bits = octet % 128
		for index = 0, 6 do
			local place = shift + index
			if math.floor(bits / 2 ^ index) % 2 == 1 then
				if place < 32 then low = low + 2 ^ place elseif place < 64 then high = high + 2 ^ (place - 32) end
			end
		end
		p, shift = p + 1, shift + 7
		if octet < 128 then return low, high, p end
	end
	return nil
end

-- Add the values of one field's bytes to a list; tell whether they are of its kind.
local function take_values(found, field, s, p, last)
	if field.kind == "string" then
		local text = s:sub(p, last)
		found[#found + 1] = {field = field, at = p - 1, size = last - p + 1, value = text}
		return utf8_text(text) == text
	elseif field.width then
		if (last - p + 1) % field.width ~= 0 or not (field.array or last - p + 1 == field.width) then return false end
		for at = p, last, field.width do
			found[#found + 1] = {field = field, at = at - 1, size = field.width}
		end
		return true
	end
	local first = p
	while p <= last do
		local low, high, behind = varint(s, p, last)
		if not low then return false end
		local value = field.kind == "bool" and low + high > 0
		if field.kind ~= "bool" then value = (field.kind == "int64" and Int64 or UInt64).new(low, high) end
		found[#found + 1] = {field = field, at = p - 1, size = behind - p, value = value}
		p = behind
	end
	return field.array or (#found > 0 and found[#found].at == first - 1)
end

-- Return the values from a place (from 0) to the end, or nil where the bytes are something else. Zeros end them.
local function body_values(s, at)
	local found, p, last = {}, at + 1, #s
	while p <= last and any_nonzero(s, p, last) do
		local key, _, behind = varint(s, p, last)
		if not key then return nil end
		local kind, field = key % 8, VALUES[math.floor(key / 8)]
		if not field then return nil end
		p = behind
		local stop
		if kind == 0 then
			local _, _, next_place = varint(s, p, last)
			stop = not (field.width or field.kind == "string") and next_place and next_place - 1
		elseif kind == 2 then
			local size, _, start = varint(s, p, last)
			if not size then return nil end
			p, stop = start, start + size - 1
		elseif kind == 1 or kind == 5 then
			stop = p + (kind == 1 and 8 or 4) - 1
		end
		if not stop or stop > last or not take_values(found, field, s, p, stop) then return nil end
		p = stop + 1
	end
	return #found > 0 and found or nil
end

-- A float as Python has it: as few digits as tell it from all others.
local function float_text(value)
	local text
	for digits = 15, 17 do
		text = format("%." .. digits .. "g", value)
		if tonumber(text) == value then break end
	end
	return text:find("^%-?%d+$") and text .. ".0" or text
end

-- The values of a message in one line.
local function body_text(values, s)
	local names, told = {}, {}
	for _, item in ipairs(values) do
		local field, text = item.field, tostring(item.value)
		if field.width then
			text = float_text((unpack(field.width == 8 and "<d" or "<f", s, item.at + 1)))
		elseif field.kind == "string" then
			text = "'" .. text .. "'"
		elseif field.kind == "bool" then
			text = item.value and "True" or "False"
		end
		if not told[field] then names[#names + 1] = field end
		local list = field.array and told[field] or {}
		list[#list + 1], told[field] = text, list
	end
	for index, field in ipairs(names) do
		local text = table.concat(told[field], ", ")
		names[index] = field.name .. " " .. (field.array and "[" .. text .. "]" or text)
	end
	return table.concat(names, ", ")
end

-- Add the values of a message, the last of each that is no array.
local function show_body(values, tree, tvb, visible)
	local newest = {}
	for _, item in ipairs(values) do newest[item.field] = item end
	for _, item in ipairs(values) do
		local field = item.field
		if (field.array or newest[field] == item) and (visible or field.record.on) then
			local range = item.size > 0 and cut(tvb, item.at, item.size) or cut(tvb, item.at - 1, 1)
			if field.width then
				add_le(tree, field.record.field, range)
			else
				add(tree, field.record.field, range, item.value)
			end
		end
	end
end

-- Read a RACS2 message: a MsgId, or the name of a topic; then the values of its body.
local function racs2(s)
	local to_cfs = byte(s, 1) * 256 <= D.limits.highest_msg_id
	if not take(to_cfs and L.racs2_message or L.racs2_topic, 0) then return nil end
	local size, values = #s - L.racs2_message.size, body_values(s, L.racs2_message.size)
	if W.listed then
		local target
		if to_cfs then
			target = format("0x%04x", (read.racs2_message(s, 1)))
		else
			target = read.racs2_topic(s, 1)
		end
		W.summary = target .. ": " .. (values and body_text(values, s) or size .. " bytes")
		if to_cfs and size > D.of_links.racs2.largest then
			W.summary = W.summary .. format(", more than the %d that cFS has room for", D.of_links.racs2.largest)
		end
	end
	W.inside[1] = function(node, tvb, visible)
		show_value(node, body_length, size, visible)
		if values then show_body(values, node, tvb, visible) end
	end
	return nil
end
HEADER_READERS.racs2 = racs2

-- Tell whether a message begins with a header of RACS2: a MsgId and zeros, or the name of a topic.
local function is_racs2(s)
	local size = D.layouts.racs2_message.size
	if #s < size then return false end
	local high, low = byte(s, 1, 2)
	local msg_id = high * 256 + low
	if msg_id > 0 and msg_id <= D.limits.highest_msg_id and not s:sub(3, size):find("[^\0]") then return true end
	if high ~= 47 and high ~= 126 and (high <= 64 or high >= 123) then return false end
	return not s:sub(1, size):find("[\128-\255]") and not s:sub(5, size):find('[ "]')
end
RECOGNISED.racs2 = is_racs2
