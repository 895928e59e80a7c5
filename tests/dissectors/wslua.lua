-- As much of Wireshark's Lua as the dissector asks for, and what it adds, as text.
-- Run: lua5.x wslua.lua SCRIPT DATAGRAMS   (a line each: number source-port destination-port hex)

local function class(name, methods)
	local made = {__name = name, __index = methods}
	methods.__class = made
	return made
end

-- Struct's codes that are asked for, by hand, so that every Lua reads alike.
local function number(s, first, last, big)
	local value = 0
	if big then
		for p = first, last do value = value * 256 + s:byte(p) end
	else
		for p = last, first, -1 do value = value * 256 + s:byte(p) end
	end
	return value
end
local function hex64(s, p, big)
	local digits = s:sub(p, p + 7):gsub(".", function(c) return string.format("%02x", c:byte()) end)
	if not big then digits = digits:gsub("(..)(..)(..)(..)(..)(..)(..)(..)", "%8%7%6%5%4%3%2%1") end
	local zero = digits:match("^0*$")
	return setmetatable({}, {__tostring = function() return zero and "0" or "0x" .. digits end})
end
local function float(s, p, size, big)
	local bits, fraction = {}, 0
	for k = 1, size do bits[k] = s:byte(big and p + k - 1 or p + size - k) end
	local sign = bits[1] >= 128 and -1 or 1
	local exponent = bits[1] % 128
	if size == 8 then
		exponent = exponent * 16 + math.floor(bits[2] / 16)
		fraction = bits[2] % 16
		for k = 3, 8 do fraction = fraction * 256 + bits[k] end
		fraction = fraction / 2 ^ 52
	else
		exponent = exponent * 2 + math.floor(bits[2] / 128)
		fraction = ((bits[2] % 128 * 256 + bits[3]) * 256 + bits[4]) / 2 ^ 23
	end
	local bias = size == 8 and 1023 or 127
	if exponent == 2 * bias + 1 then return fraction == 0 and sign * math.huge or 0 / 0 end
	if exponent == 0 then return sign * fraction * 2.0 ^ (1 - bias) end
	return sign * (1 + fraction) * 2.0 ^ (exponent - bias)
end
Struct = {unpack = function(code, s, p)
	local big, out = false, {}
	p = p or 1
	for letter, digits in code:gmatch("([<>%a])(%d*)") do
		local size = tonumber(digits) or 1
		if letter == "<" or letter == ">" then big = letter == ">"
		elseif letter == "x" then p = p + 1
		elseif letter == "e" or letter == "E" then out[#out + 1] = hex64(s, p, big) p = p + 8
		elseif letter == "f" or letter == "d" then
			size = letter == "f" and 4 or 8
			out[#out + 1] = float(s, p, size, big) p = p + size
		else
			local value = number(s, p, p + size - 1, big)
			if letter:find("[bhi]") and value >= 256 ^ size / 2 then value = value - 256 ^ size end
			assert(#s >= p + size - 1, "out of bounds")
			out[#out + 1] = math.floor(value) p = p + size
		end
	end
	out[#out + 1] = p
	return (table.unpack or unpack)(out)
end}
local function xor(...)
	local value = 0
	for _, other in ipairs({...}) do
		local result, place = 0, 1
		local a, b = value % 2 ^ 32, other % 2 ^ 32
		for _ = 1, 32 do
			if a % 2 ~= b % 2 then result = result + place end
			a, b, place = math.floor(a / 2), math.floor(b / 2), place * 2
		end
		value = result
	end
	return value
end
bit = {bxor = xor, rshift = function(a, n) return math.floor(a % 2 ^ 32 / 2 ^ n) end,
	band = function(a, b) assert(b == 255) return a % 256 end}

base = {DEC = 1, HEX = 2}
expert = {group = {PROTOCOL = 1, SEQUENCE = 2}, severity = {NOTE = 1, WARN = 2, ERROR = 3}}
function gui_enabled() return false end
ProtoExpert = {new = function(name) return {expert = name} end}
ProtoField = setmetatable({}, {__index = function(_, kind)
	return function(abbreviation) return {abbreviation = abbreviation, kind = kind} end
end})
Pref = setmetatable({}, {__index = function() return function(_, value) return value end end})
function Proto(name, title) return {abbreviation = name, title = title, prefs = {}, kind = "proto"} end
local handed
DissectorTable = {get = function() return {add = function(_, _, proto) handed = proto end, remove = function() end,
	add_for_decode_as = function() end} end}
Dissector = {get = function(name) return name end}
Address = {ip = function(text) return text end}

local out = {}
local function shown(value)
	if type(value) == "number" then return string.format("%.10g", value) end
	return tostring(value)
end
Tvb = {}
local tvb_meta = {__index = Tvb}
function Tvb.raw(self) return self.s end
function Tvb.offset() return 42 end
function Tvb.len(self) return #self.s end
Tvb.captured_len, Tvb.reported_len = Tvb.len, Tvb.len
local range_meta = {__index = {
	uint64 = function(r) return shown(number(r.s, r.at + 1, r.at + r.size, true)) end,
	bitfield = function(r, first, bits)
		return math.floor(number(r.s, r.at + 1, r.at + r.size, true) / 2 ^ (8 * r.size - first - bits)) % 2 ^ bits
	end,
	le_uint64 = function(r) return shown(number(r.s, r.at + 1, r.at + r.size, false)) end,
}}
function Tvb.range(self, at, size)
	assert(at >= 0 and size >= 0 and at + size <= #self.s, "range out of bounds")
	assert(math.floor(at) == at and math.floor(size) == size)
	return setmetatable({s = self.s, at = at, size = size}, range_meta)
end
tvb_meta.__call = Tvb.range
TreeItem = {}
local item_meta = {__index = TreeItem}
local function item(field, range, value, text, order)
	assert(field, "no field")
	local bytes = range and getmetatable(range) == range_meta
	if not bytes then value, text, range = range, value, nil end
	if field.kind == "proto" then text, value = value, nil end
	out[#out + 1] = table.concat({
		field.abbreviation, order, bytes and string.format("%d+%d", range.at, range.size) or "-",
		value == nil and "" or shown(value), text or "",
	}, " ")
	return setmetatable({visible = true, text = field.abbreviation .. ": "}, item_meta)
end
function TreeItem.add(_, ...) local f, r, v, t = ... return item(f, r, v, t, "be") end
function TreeItem.add_le(_, ...) local f, r, v, t = ... return item(f, r, v, t, "le") end
function TreeItem.set_generated(i) out[#out + 1] = "  generated" return i end
function TreeItem.set_text(i, text) out[#out + 1] = "  text " .. text return i end
function TreeItem.append_text(i, text) out[#out + 1] = "  more " .. text return i end
function TreeItem.add_proto_expert_info(i, e) out[#out + 1] = "  expert " .. e.expert return i end
function TreeItem.referenced() return true end

dofile(arg[1])
if handed.init then handed.init() end
for line in io.lines(arg[2]) do
	local frame, from, to, hex = line:match("^(%d+) (%d+) (%d+) (%x*)$")
	local s = hex:gsub("..", function(h) return string.char(tonumber(h, 16)) end)
	local info = setmetatable({}, {__tostring = function() return "" end})
	local cols = setmetatable({}, {__index = function() return info end, __newindex = function(_, name, text)
		out[#out + 1] = "column " .. name .. " " .. text
	end})
	local pinfo = {number = tonumber(frame), visited = false, src = "127.0.0.1", dst = "127.0.0.1",
		src_port = tonumber(from), dst_port = tonumber(to), cols = cols, in_error_pkt = false, port_type = 3,
		abs_ts = 1.8e9 + tonumber(frame)}
	out = {}
	local done = handed.dissector(setmetatable({s = s}, tvb_meta), pinfo, setmetatable({visible = true}, item_meta))
	print(frame, done)
	print(table.concat(out, "\n"))
end
