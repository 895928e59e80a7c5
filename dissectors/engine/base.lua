-- Small tools that all parts share.

local bit = bit
local unpack, format = Struct.unpack, string.format
local analysis = {}  -- what the sequence count says of a frame: a gap's size, "duplicate" or "reordered"

-- A text field, cut at its first NUL.
function D.text(s, first, last)
	local stop = s:find("\0", first, true)
	return s:sub(first, (stop and stop <= last) and stop - 1 or last)
end

local FOLLOWING = {}  -- first byte of a UTF-8 character: how many follow, and which the second may be
for octet = 0xC2, 0xDF do FOLLOWING[octet] = {1, 0x80, 0xBF} end
for octet = 0xE0, 0xEF do FOLLOWING[octet] = {2, 0x80, 0xBF} end
for octet = 0xF0, 0xF4 do FOLLOWING[octet] = {3, 0x80, 0xBF} end
FOLLOWING[0xE0][2], FOLLOWING[0xED][3] = 0xA0, 0x9F
FOLLOWING[0xF0][2], FOLLOWING[0xF4][3] = 0x90, 0x8F

-- Text as UTF-8, its mistakes replaced (Unicode 3.9: one U+FFFD for each maximal part).
local function utf8_text(s)
	if not s:find("[\128-\255]") then
		return s
	end
	local out, p = {}, 1
	while p <= #s do
		local first = s:byte(p)
		local rule, q = FOLLOWING[first], p + 1
		local whole = first < 0x80 or rule ~= nil
		for index = 1, rule and rule[1] or 0 do
			local next_byte = s:byte(q)
			local low, high = 0x80, 0xBF
			if index == 1 then low, high = rule[2], rule[3] end
			if not next_byte or next_byte < low or next_byte > high then
				whole = false
				break
			end
			q = q + 1
		end
		out[#out + 1] = whole and s:sub(p, q - 1) or "\239\191\189"
		p = q
	end
	return table.concat(out)
end

-- A Unicode scalar as UTF-8.
local function utf8_character(code)
	if code < 0x80 then
		return string.char(code)
	elseif code < 0x800 then
		return string.char(0xC0 + math.floor(code / 64), 0x80 + code % 64)
	elseif code < 0x10000 then
		return string.char(0xE0 + math.floor(code / 4096), 0x80 + math.floor(code / 64) % 64, 0x80 + code % 64)
	end
	return string.char(
		0xF0 + math.floor(code / 262144), 0x80 + math.floor(code / 4096) % 64,
		0x80 + math.floor(code / 64) % 64, 0x80 + code % 64
	)
end

-- A wide string: UTF-16 units of some bytes each; half a surrogate pair is replaced.
local function wide_text(s, first, last, width, big)
	local out, p = {}, first
	local code = (big and ">I" or "<I") .. string.format("%d", width)
	while p <= last do
		local unit = unpack(code, s, p) % 65536
		p = p + width
		if unit >= 0xD800 and unit < 0xDC00 and p <= last then
			local low = unpack(code, s, p) % 65536
			if low >= 0xDC00 and low < 0xE000 then
				p = p + width
				unit = 0x10000 + (unit - 0xD800) * 1024 + low - 0xDC00
			else
				unit = 0xFFFD
			end
		elseif unit >= 0xD800 and unit < 0xE000 then
			unit = 0xFFFD
		end
		out[#out + 1] = utf8_character(unit)
	end
	return table.concat(out)
end

local FOLD = {}  -- a format for each number of words
for words = 1, 64 do FOLD[words] = "<" .. string.rep("I4", words) end

-- cFE's checksum, 0 for a packet that is right: 0xFF XOR every byte. XOR is blind to order, so words fold first.
local function checksum(s, first, last)
	local word, p = 0, first
	while last - p >= 3 do
		local words = math.min(64, math.floor((last - p + 1) / 4))
		-- The last value is where the reading ended: it is told to cancel itself out.
		local stop = p + 4 * words
		word = bit.bxor(word, stop, unpack(FOLD[words], s, p))
		p = stop
	end
	if p <= last then
		word = bit.bxor(word, s:byte(p, last))
	end
	word = bit.bxor(word, bit.rshift(word, 16))
	return bit.band(bit.bxor(word, bit.rshift(word, 8), 0xFF), 0xFF)
end

-- The steps of the CRCs by byte: CRC-16 of CCSDS, and CRC-32 of IEEE 802.3.
local CRC16, CRC32 = {}, {}
for octet = 0, 255 do
	local left, right = octet * 256, octet
	for _ = 1, 8 do
		left = left >= 0x8000 and bit.bxor(left * 2 % 0x10000, 0x1021) or left * 2
		right = right % 2 == 1 and bit.bxor((right - 1) / 2, 0xEDB88320) % 0x100000000 or right / 2
	end
	CRC16[octet], CRC32[octet] = left, right
end

local function crc16(s, first, last)
	local crc, xor, byte = 0xFFFF, bit.bxor, string.byte
	for p = first, last do
		local low = crc % 256
		crc = xor(low * 256, CRC16[xor((crc - low) / 256, byte(s, p))])
	end
	return crc
end

local function crc32(s, first, last)
	local crc, xor, shift, byte = 0xFFFFFFFF, bit.bxor, bit.rshift, string.byte
	for p = first, last do
		crc = xor(shift(crc, 8), CRC32[xor(crc % 256, byte(s, p))])
	end
	return xor(crc, 0xFFFFFFFF) % 0x100000000
end

-- A line has no line ends; a format would end at a NUL.
local function printable(text)
	return text:find("%c") and text:gsub("%c", " ") or text
end

-- Tell whether any byte of a stretch is not 0.
local function any_nonzero(s, first, last)
	local found = first <= last and s:find("[^\0]", first)
	return found and found <= last or false
end

-- A set of port numbers from "1234-1237,2000".
local function port_set(text)
	local set = {}
	for part in tostring(text):gmatch("[^,%s]+") do
		local low, high = part:match("^(%d+)%-(%d+)$")
		low, high = tonumber(low or part), tonumber(high or part)
		for port = low or 1, high or 0 do set[port] = true end
	end
	return set
end
